"""Motions as nodes in flat arrays, and following them from where the robot is."""
