"""Bringing a real robot up: what is tried before anything is recorded, as data. No ROS."""
