"""System identification and diagnosis: recordings, checks, fits and reports."""
