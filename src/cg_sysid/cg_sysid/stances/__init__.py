"""Which foot stands: touchdowns of a walk, and the phases between them."""
