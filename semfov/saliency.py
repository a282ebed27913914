"""Where an image attracts the gaze (`semfov.gaze.saliency`)."""

import sys

from semfov.attribute_words import Room
from semfov.gaze.saliency import *  # noqa: F403
from semfov.gaze.saliency import __all__  # noqa: F401 (the same public names)

sys.modules[__name__].__class__ = Room
