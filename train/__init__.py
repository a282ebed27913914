"""Applications that fit semfov's models to data."""
