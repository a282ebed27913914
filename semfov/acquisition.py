"""Acquisition functions: the value of fixating each cell next (`semfov.gaze.acquisition`)."""

from semfov.gaze.acquisition import *  # noqa: F403
from semfov.gaze.acquisition import __all__  # noqa: F401 (the same public names)
