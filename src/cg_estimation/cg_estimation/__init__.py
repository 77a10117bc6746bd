"""The observer, and the filters it is compared with."""
