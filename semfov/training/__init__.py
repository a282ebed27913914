"""Fit semfov's models to photographs with annotated boxes."""
