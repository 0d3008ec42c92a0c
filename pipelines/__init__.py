"""The GeoRefGS library: every stage and building block, importable without the command line."""

__version__ = "0.1.0"
