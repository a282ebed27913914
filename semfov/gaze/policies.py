"""The named search policies: which acquisition function looks for a target."""

from collections.abc import Callable

from torch import Tensor, nn

from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.search import FovealModel, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Uniform

Policy = Callable[[int | Tensor], nn.Module]
"""Makes the acquisition function for a target class (an index, or one for each episode)."""

SEARCH_POLICIES = ("random", "non-predictive", "predictive")


def search_policy(name: str, model: FovealModel | None = None, *, calibrated: bool = False) -> Policy:
    """A search policy by its name in the literature.

    Args:
        name: `random`, `non-predictive` (`TargetPosterior`) or `predictive` (`PredictedTargetPosterior`).
        model: the observation model; `predictive` needs one.
        calibrated: whether predicted scores are calibrated, as an agent does that calibrates what it sees.

    Raises:
        InputError: the name is unknown, or `predictive` came without a model.

    >>> search_policy("non-predictive")(3)
    TargetPosterior()
    """
    lookup(name, SEARCH_POLICIES, "search policy")
    if name == "random":
        return lambda target: Uniform()
    if name == "non-predictive":
        return TargetPosterior
    if model is None:
        raise InputError("policy 'predictive': expected an observation model for the scores to expect, got none")
    return lambda target: PredictedTargetPosterior(target, model, calibrated=calibrated)
