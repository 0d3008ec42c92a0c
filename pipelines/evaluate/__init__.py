"""Stage `evaluate`: test views, check points, predicted accuracy."""
