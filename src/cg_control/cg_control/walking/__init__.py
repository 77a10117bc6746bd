"""Trees of robots that walk."""
