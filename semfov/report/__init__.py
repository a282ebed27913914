"""HTML pages on which a reader steps through episodes in a browser."""
