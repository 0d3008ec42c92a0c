"""Pieces that several stages share: they join formats, splat and georef."""
