"""Periodic motions: planned, closed, stabilised across them."""
