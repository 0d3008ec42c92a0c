"""Change between two surveys of one place: `georef change`."""
