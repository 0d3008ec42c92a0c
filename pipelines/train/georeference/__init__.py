"""Georeference of a training: its unknowns as tensors, and the losses on them."""
