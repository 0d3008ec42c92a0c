"""Geographic losses, their weighting, the learnable similarity and camera corrections."""
