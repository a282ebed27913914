"""Where an image attracts the gaze (`semfov.gaze.saliency`)."""

from semfov.gaze.saliency import *  # noqa: F403
from semfov.gaze.saliency import __all__  # noqa: F401 (the same public names)
