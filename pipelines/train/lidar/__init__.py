"""LiDAR in training: cloud in the scene, registration, changes, and the surface that Gaussians are held to."""
