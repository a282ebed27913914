"""Applications that measure semfov: visual search, exploration, calibration."""
