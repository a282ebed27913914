"""Observers: they turn looks into a belief (`semfov.belief.observers`)."""

from semfov.belief.observers import *  # noqa: F403
from semfov.belief.observers import __all__  # noqa: F401 (the same public names)
