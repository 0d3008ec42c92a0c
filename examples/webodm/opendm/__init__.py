"""Package in which NodeODM looks for the options of an engine."""
