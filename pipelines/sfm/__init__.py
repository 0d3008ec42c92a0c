"""Stage `sfm`: cameras and points with COLMAP; and the adjustment with position priors, `compare`'s baseline."""
