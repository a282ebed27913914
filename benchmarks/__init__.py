"""Measurements against other implementations: `python -m benchmarks.NAME`."""
