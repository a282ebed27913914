"""Fits the prior of context: where classes usually are, and beside which other classes."""
