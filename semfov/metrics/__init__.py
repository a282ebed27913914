"""Measures of searches, explorations, probabilities, detections and scanpaths."""

from semfov.words import METRICS, missing


def __getattr__(name: str) -> object:
    """Name the module of a measure."""
    raise missing("semfov.metrics", name, METRICS)
