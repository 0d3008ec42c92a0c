"""Pages for people: one HTML file that holds all it shows, and its PDF. Sole home of jinja2."""
