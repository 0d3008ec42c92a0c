"""Stage `evaluate`: figures of test views, errors of check points."""
