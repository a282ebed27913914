"""Policies: where to look, by an acquisition function (`semfov.gaze.policies`)."""

from semfov.attribute_words import POLICIES, missing
from semfov.gaze.policies import *  # noqa: F403
from semfov.gaze.policies import __all__


def __getattr__(name: str) -> object:
    """Suggest ours where others have another word for it."""
    raise missing("semfov.policies", name, POLICIES, __all__)
