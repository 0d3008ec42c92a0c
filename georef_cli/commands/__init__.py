"""Commands of `georef`, one module for each."""
