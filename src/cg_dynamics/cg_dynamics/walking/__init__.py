"""Walking: impacts, contact, hybrid simulation, gaits."""
