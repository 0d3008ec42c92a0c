"""Stage `export-raster`: orthophoto, surface model and their σ as rasters in a CRS, contours and pictures."""
