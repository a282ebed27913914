"""Fits models of how people choose their next fixation."""
