"""Comparison of the model's surface with a reference cloud."""
