"""The adjustment: where things are, and how well that is known."""
