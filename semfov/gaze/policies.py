"""The named search policies: which acquisition function looks for a target."""

from collections.abc import Callable

from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.search import FovealModel, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Uniform

Policy = Callable[[int | Tensor, Grid], nn.Module]
"""Makes the acquisition function for a component of the belief (an index, or one for each episode) on a grid."""

SEARCH_POLICIES = ("random", "non-predictive", "predictive")


def search_policy(name: str, model: FovealModel | None = None, *, calibrated: bool = False) -> Policy:
    """A search policy by its name in the literature.

    Args:
        name: `random`, `non-predictive` (`TargetPosterior`) or `predictive` (`PredictedTargetPosterior`).
        model: the observation model; `predictive` needs one.
        calibrated: whether predicted scores are calibrated, as an agent does that calibrates what it sees.

    Raises:
        InputError: the name is unknown, or `predictive` came without a model.

    >>> search_policy("non-predictive")(3, Grid(10, 10, (640, 480)))
    TargetPosterior()
    """
    lookup(name, SEARCH_POLICIES, "search policy")
    if name == "random":
        return lambda target, grid: Uniform()
    if name == "non-predictive":
        return lambda target, grid: TargetPosterior(target)
    if model is None:
        raise InputError("policy 'predictive': expected an observation model for the scores to expect, got none")
    return lambda target, grid: PredictedTargetPosterior(target, model, calibrated=calibrated)
