"""Every picture with axes. Sole home of matplotlib."""
