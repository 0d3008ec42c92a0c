"""Rasterisers behind one interface."""
