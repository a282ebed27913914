"""Fits, for a detector, everything that the agent needs."""
