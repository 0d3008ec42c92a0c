"""Robust kernels, RANSAC and statistics (numpy, float64)."""
