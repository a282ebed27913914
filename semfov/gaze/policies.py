"""Policies: where to look, by an acquisition function, for any target on any grid."""

from typing import Any, get_args

from torch import Tensor, nn

from semfov.belief import Grid, MapEvidence
from semfov.errors import InputError, check, lookup
from semfov.gaze.acquisition.base import FUNCTIONS, AcquisitionFunction, Task
from semfov.gaze.acquisition.lookahead import sampled_likelihoods
from semfov.observation.foveal import FovealObservationModel

__all__ = ["Policy", "policy_names"]


class Policy(nn.Module):
    """Look at the best cell by an acquisition function, for any target on any grid.

    `random`, `non-predictive`, `predictive`, `kl`, `negative-entropy` and `two-peaks` are the policies of Luzio,
    Bernardino and Moreno (2024). `entropy-limit` and `ideal-observer` are those of Najemnik and Geisler (2009, 2005),
    whose maximum a posteriori searcher equals `non-predictive`. The others are ours.

    Args:
        function: name of an acquisition function (`policy_names`), or its class.
        model: model that the function is made from; one that needs none leaves it out.
        samples: number of looks that are drawn for each class and level, over which a function that predicts looks
            takes the expectation; the model's Dirichlets must be densities of the scores. None takes the look with the
            expected scores, as published.
        calibrated: whether the scores of a drawn look are calibrated before they update the belief.
        settings: further arguments of the acquisition function, None included; parameters and modules among them are
            those of the policy. Their names are others than those of arguments and attributes of `Policy`.

    Raises:
        InputError: there is no such function or setting, or one of a name that is not free, the model is missing, or
            `samples` does not suit it.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Policy("kl", FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]), prior=1.0)
    >>> policy(None, Grid(4, 3, (40, 30))).prior
    1.0
    >>> Policy("non-predictive")(3, Grid(4, 3, (40, 30)))
    TargetPosterior()
    """

    likelihoods: Tensor

    def __init__(
        self,
        function: str | type[AcquisitionFunction],
        model: FovealObservationModel | MapEvidence | None = None,
        *,
        samples: int | None = None,
        calibrated: bool = True,
        **settings: Any,
    ) -> None:
        super().__init__()
        if not isinstance(function, type):
            function = FUNCTIONS[lookup(function, FUNCTIONS, "policy")]
        kind = getattr(function, "__name__", function)
        check(issubclass(function, AcquisitionFunction), "function", "a class of acquisition functions", kind)
        self.function = function
        takes = self.function.takes
        needed = MapEvidence if self.function.needs_map else FovealObservationModel
        if "model" in takes and not isinstance(model, needed):
            words = "a learned map" if self.function.needs_map else "an observation model"
            got = "none" if model is None else f"a {type(model).__name__}"
            raise InputError(f"policy {self.name!r}: expected {words}, got {got}")
        self.model = model if "model" in takes else None
        own = [name for name in takes if name not in ("target", "model", "grid")]
        taken = [name for name in own if name in ("samples", "calibrated") or hasattr(self, name)]
        check(not taken, "function", "one whose settings have other names than what a policy has", ", ".join(taken))
        self._given = [lookup(name, own, f"setting of policy {self.name!r}") for name in settings]
        if samples is not None:
            check("likelihoods" in takes, "samples", f"None for policy {self.name!r}, which predicts no look", samples)
            assert isinstance(model, FovealObservationModel)
            settings["likelihoods"] = sampled_likelihoods(model, samples, calibrated=calibrated)
            self._given.append("likelihoods")
        for name, value in settings.items():
            if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
                self.register_buffer(name, value, persistent=False)
            else:
                setattr(self, name, value)

    @property
    def name(self) -> str:
        """Name of the acquisition function, or of its class where it has none."""
        return self.function.name or self.function.__name__

    def extra_repr(self) -> str:
        """The name."""
        return repr(self.name)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """Make the acquisition function for a target on a grid.

        Args:
            target: class 1..K, a tensor `(B,)` with one for each episode, or None in an exploration.
            grid: the cells.

        Returns:
            The acquisition function.

        Raises:
            InputError: the function needs a target or a setting, and has none, or has one of another type.
        """
        given = {"target": target, "model": self.model, "grid": grid}
        given = {name: value for name, value in given.items() if value is not None and name in self.function.takes}
        given |= {name: getattr(self, name) for name in self._given}
        for name, parameter in self.function.takes.items():
            if given.get(name) is None and parameter.default is parameter.empty:
                needed = {"target": "a target to search for"}.get(name, f"{name} of a scene")
                raise InputError(f"policy {self.name!r}: expected {needed}, got none")
        try:
            return self.function(**given)
        except TypeError as error:
            expected = f"values that fit {', '.join(given)}"
            raise InputError(f"policy {self.name!r}: expected {expected}, got others ({error})") from error


def policy_names(task: Task) -> list[str]:
    """Names of the acquisition functions for a task, in the order of registration.

    Args:
        task: `search` or `exploration`.

    Returns:
        The names.

    Raises:
        InputError: there is no such task.

    >>> "predictive" in policy_names("search"), "kl" in policy_names("search")
    (True, False)
    """
    lookup(task, get_args(Task), "task")
    return [name for name, function in FUNCTIONS.items() if task in function.tasks]
