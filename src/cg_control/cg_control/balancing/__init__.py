"""Standing on one leg: the design model, regulators, and from where they catch the robot."""
