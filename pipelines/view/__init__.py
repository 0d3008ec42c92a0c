"""The local viewer, and measuring in the trained model."""
