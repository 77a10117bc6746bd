"""Is a recording sound? Checked before anything is fitted."""
