"""Commands of `georef`: one module for each, one for all stages, and one for the cluster."""
