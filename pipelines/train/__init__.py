"""Stage `train`: joint optimisation of Gaussians, similarity and cameras."""
