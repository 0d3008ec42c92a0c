"""Where things are on Earth: reference systems, the tangent frame, heights. Sole home of pyproj."""
