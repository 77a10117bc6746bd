"""Whole-robot configurations, experiments and the demonstration."""
