"""Where to look next: acquisition functions over the belief, and the choice of a fixation from them."""

from semfov.gaze import acquisition, saliency
from semfov.gaze.learned import LearnedGaze
from semfov.gaze.policies import EXPLORATION_POLICIES, SEARCH_POLICIES, Policy, exploration_policy, search_policy
from semfov.gaze.relaxation import soft_fixation
from semfov.gaze.selection import select_fixation

__all__ = [
    "EXPLORATION_POLICIES",
    "LearnedGaze",
    "SEARCH_POLICIES",
    "Policy",
    "acquisition",
    "exploration_policy",
    "saliency",
    "search_policy",
    "select_fixation",
    "soft_fixation",
]
