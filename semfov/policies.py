"""Policies: where to look, by an acquisition function (`semfov.gaze.policies`)."""

from semfov.gaze.policies import *  # noqa: F403
from semfov.gaze.policies import __all__  # noqa: F401 (the same public names)
