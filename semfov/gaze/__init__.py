"""Where to look next: acquisition functions over the belief, and the choice of a fixation from them."""

from semfov.gaze import acquisition, saliency
from semfov.gaze.policies import SEARCH_POLICIES, Policy, search_policy
from semfov.gaze.selection import select_fixation

__all__ = ["SEARCH_POLICIES", "Policy", "acquisition", "saliency", "search_policy", "select_fixation"]
