"""One motion: what is asked of it, direct collocation, and feedback along it."""
