"""The hardware of the robot, and the simulated machine that stands in for it."""
