"""Rotations, similarities, cameras and rays. Plain numpy, float64."""
