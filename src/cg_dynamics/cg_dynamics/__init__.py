"""The model: rigid bodies, effects, impact, linearisation, compiled functions, simulation."""
