"""Identification by simulation error: unknowns, data sets, fits, uncertainty."""
