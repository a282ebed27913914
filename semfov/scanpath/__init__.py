"""The record of an episode: fixations, detections, beliefs and the decision."""

from semfov.scanpath.record import Ending, Scanpath, describe, why_it_ended
from semfov.scanpath.stimulus import Stimulus, sensor_in_words
from semfov.scanpath.trace import trace

__all__ = ["Ending", "Scanpath", "Stimulus", "describe", "sensor_in_words", "trace", "why_it_ended"]
