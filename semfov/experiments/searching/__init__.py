"""Searches beside people's: how soon targets are found, and how alike scanpaths are."""
