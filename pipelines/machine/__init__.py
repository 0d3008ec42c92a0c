"""The machine: what `georef` finds on it, and what is missing."""
