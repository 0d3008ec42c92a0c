"""Stage `train`: Gaussians, similarity and cameras together."""
