"""Pages to step through in a browser."""
