"""Point cloud: the fused surface of the trained model."""
