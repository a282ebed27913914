"""Fitting semfov's models to photographs with boxes."""
