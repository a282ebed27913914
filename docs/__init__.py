"""The documentation, and the code that builds the site from it."""
