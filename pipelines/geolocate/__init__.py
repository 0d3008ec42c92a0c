"""Stage `geolocate`: every SfM point intersected on Earth."""
