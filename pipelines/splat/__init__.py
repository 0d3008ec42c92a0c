"""The Gaussians: model, spherical harmonics, losses, densification, metrics."""
