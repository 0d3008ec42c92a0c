"""Gaussians: model, spherical harmonics, losses, density control, metrics."""
