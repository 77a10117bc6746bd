"""Recordings: what a bag holds, how it is read, written, aligned, recorded and recovered."""
