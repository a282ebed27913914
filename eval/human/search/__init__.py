"""Comparison of searchers with people: how soon they find targets, and how similar their scanpaths are."""
