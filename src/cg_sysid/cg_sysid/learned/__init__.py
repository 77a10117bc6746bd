"""Learned terms: what no effect of the library explains, as a function that data drew."""
