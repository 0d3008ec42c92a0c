"""Stage `init-sim3`: the similarity from the SfM model to the Earth."""
