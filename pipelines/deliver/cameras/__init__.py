"""Export of the trained cameras: COLMAP, nerfstudio, a table for surveyors, footprints for maps."""
