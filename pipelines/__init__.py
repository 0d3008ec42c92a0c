"""The GeoRefGS library: every stage and building block, importable without the command line."""
