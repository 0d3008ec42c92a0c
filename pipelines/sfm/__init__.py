"""Stage `sfm`: cameras and points by COLMAP; and the adjustment with position priors, the baseline of `compare`."""
