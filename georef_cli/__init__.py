"""The command line of GeoRefGS: parse, call, print."""
