"""Where to look next: acquisition functions over the belief, policies, and the choice of a fixation."""

import sys

from semfov.attribute_words import Room
from semfov.gaze import acquisition, policies, saliency
from semfov.gaze.choice import Choice, Given, Greedy, Relaxed, Softmax, select_fixation, soft_fixation
from semfov.gaze.policies import Policy
from semfov.gaze.viewer import Viewer

__all__ = [
    "Choice",
    "Given",
    "Greedy",
    "Policy",
    "Relaxed",
    "Softmax",
    "Viewer",
    "acquisition",
    "policies",
    "saliency",
    "select_fixation",
    "soft_fixation",
]

sys.modules[__name__].__class__ = Room
