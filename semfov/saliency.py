"""Where an image attracts the gaze (`semfov.gaze.saliency`)."""

import sys

from semfov.gaze.saliency import *  # noqa: F403
from semfov.gaze.saliency import __all__  # noqa: F401 (the same public names)
from semfov.words import Room

sys.modules[__name__].__class__ = Room
