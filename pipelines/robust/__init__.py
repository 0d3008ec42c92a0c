"""Robust losses, RANSAC and statistics. Plain numpy, float64."""
