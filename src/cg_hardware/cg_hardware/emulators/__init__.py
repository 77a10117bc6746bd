"""Devices that are not there, on wires that are: for tests, and for trying a robot at the desk."""
