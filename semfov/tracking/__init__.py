"""Objects of a stream that move: a place, a velocity, a number that stays, and a probability while they are hidden."""

from semfov.tracking.model import TrackingModel
from semfov.tracking.tracker import Seen, Tracker
from semfov.tracking.tracks import Tracks

__all__ = ["Seen", "Tracker", "TrackingModel", "Tracks"]
