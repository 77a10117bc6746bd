"""The diagnosis: the loop over causes, its result, and the next experiment."""
