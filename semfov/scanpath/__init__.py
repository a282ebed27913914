"""The record of an episode: where the gaze went, what was seen, what was believed, and what came of it."""

from semfov.scanpath.record import Ending, Scanpath, describe, why_it_ended
from semfov.scanpath.stimulus import Stimulus, sensor_in_words
from semfov.scanpath.trace import trace

__all__ = ["Ending", "Scanpath", "Stimulus", "describe", "sensor_in_words", "trace", "why_it_ended"]
