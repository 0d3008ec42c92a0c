"""Command line of GeoRefGS: parses arguments, calls the stages, prints results."""
