"""LQR-trees: growth by falsification, what they hold, and coming home along them."""
