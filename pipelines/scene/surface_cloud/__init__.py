"""Point cloud of the fused surface of the trained model, in `geo`."""
