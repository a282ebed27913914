"""Measures of searches, explorations, probabilities, detections and scanpaths."""
