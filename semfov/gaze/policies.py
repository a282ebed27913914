"""Policies: they look at the best cell by an acquisition function, for any target and grid."""

from collections.abc import Mapping
from typing import get_args

from torch import Tensor, nn

from semfov.belief import Grid
from semfov.errors import InputError, check, lookup, type_of
from semfov.gaze.acquisition.base import FUNCTIONS, AcquisitionFunction, Task
from semfov.gaze.acquisition.lookahead import DrawnLooks
from semfov.observation.foveal import FovealObservationModel

__all__ = ["Policy", "policy_names"]


class Policy(nn.Module):
    """Look at the best cell by an acquisition function, for any target on any grid.

    `random`, `non-predictive`, `predictive`, `kl`, `negative-entropy` and `two-peaks` are the policies of Luzio,
    Bernardino and Moreno (2024). `entropy-limit` and `ideal-observer` are those of Najemnik and Geisler (2009, 2005),
    whose maximum a posteriori searcher equals `non-predictive`. The others are ours.

    Args:
        function: name of an acquisition function (`policy_names`), or its class.
        model: observation model for the function; ignored if it needs none.
        samples: number of simulated looks for each class and level, over which a function that predicts looks averages;
            the model's Dirichlets must be densities of the scores. None: one look with the expected scores, as in the
            paper. The looks are drawn again when the model has changed, except in a compiled graph and in `torch.func`.
        calibrated: whether the scores of a drawn look are calibrated before they update the belief.
        settings: further arguments of the acquisition function. Parameters and modules among them become part of the
            policy. Their names must differ from arguments and attributes of `Policy`.

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

    def __init__(
        self,
        function: str | type[AcquisitionFunction],
        model: FovealObservationModel | None = None,
        *,
        samples: int | None = None,
        calibrated: bool = True,
        **settings: object,
    ) -> None:
        super().__init__()
        self.drawn_looks: DrawnLooks | None = None
        self.function = _function_class(function)
        self.model = self._model_for(model)
        self._check_settings(settings)
        if samples is not None:
            predicts = "likelihoods" in self.function.takes
            check(predicts, "samples", f"None for policy {self.name!r}, which predicts no look", samples)
            assert isinstance(model, FovealObservationModel)
            self.drawn_looks = DrawnLooks(model, samples, calibrated=calibrated)
        self._settings = list(settings)
        for name, value in settings.items():
            if isinstance(value, Tensor) and not isinstance(value, nn.Parameter):
                self.register_buffer(name, value, persistent=False)
            else:
                setattr(self, name, value)

    def _model_for(self, model: FovealObservationModel | None) -> FovealObservationModel | None:
        """Check the model that the function is made from; None if it is made from none."""
        if "model" not in self.function.takes:
            return None
        if not isinstance(model, FovealObservationModel):
            got = "none" if model is None else type_of(model)
            raise InputError(f"policy {self.name!r}: expected an observation model, got {got}")
        return model

    def _check_settings(self, settings: Mapping[str, object]) -> None:
        """Check that the function has these settings, and none with a name that a policy has itself."""
        names = [name for name in self.function.takes if name not in ("target", "model", "grid")]
        taken = [name for name in names if name in ("samples", "calibrated") or hasattr(self, name)]
        check(not taken, "function", "one whose settings have other names than what a policy has", ", ".join(taken))
        for name in settings:
            lookup(name, names, f"setting of policy {self.name!r}")

    @property
    def name(self) -> str:
        """Name of the acquisition function, or of its class if the function has no name."""
        return self.function.name or self.function.__name__

    def extra_repr(self) -> str:
        """Return the policy's name for `repr`."""
        return repr(self.name)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """Make the acquisition function for a target on a grid.

        Args:
            target: class 1..K, a tensor `(B,)` with one for each episode, or None in an exploration.
            grid: the cells.

        Returns:
            The acquisition function.

        Raises:
            InputError: the function needs a target or a setting, and has none, or has one of another type; or what is
                given are the arguments of the function that a policy makes.
        """
        values = "the values of the cells are policy(target, grid)(belief, visited)"
        check(
            isinstance(grid, Grid), "grid", "a grid, as a policy is called with a target", f"{type_of(grid)}; {values}"
        )
        likelihoods = None if self.drawn_looks is None else self.drawn_looks(self.model)
        arguments = self._arguments({"target": target, "model": self.model, "grid": grid, "likelihoods": likelihoods})
        try:
            return self.function(**arguments)
        except TypeError as error:
            expected = f"values that fit {', '.join(arguments)}"
            raise InputError(f"policy {self.name!r}: expected {expected}, got others ({error})") from error

    def _arguments(self, scene: Mapping[str, object]) -> dict[str, object]:
        """Choose what the function takes of a scene, and add the settings; raises `InputError` for what it lacks."""
        arguments: dict[str, object] = {}
        for name, parameter in self.function.takes.items():
            value = getattr(self, name) if name in self._settings else scene.get(name)
            is_needed = parameter.default is parameter.empty
            if is_needed and value is None:
                expected = "a target to search for" if name == "target" else f"{name} of a scene"
                raise InputError(f"policy {self.name!r}: expected {expected}, got none")
            # A setting may be None; of a scene, None is no argument, and the default stands.
            if name in self._settings or value is not None:
                arguments[name] = value
        return arguments


def _function_class(function: str | type[AcquisitionFunction]) -> type[AcquisitionFunction]:
    """Find the class of an acquisition function by its name; a class of one is returned as it is."""
    if isinstance(function, type):
        expected = "a class of acquisition functions"
        check(issubclass(function, AcquisitionFunction), "function", expected, function.__name__)
        return function
    expected = "the name of an acquisition function, or its class, to be made for each target"
    check(isinstance(function, str), "function", expected, type_of(function))
    # All names, the baselines included, are listed for the message alone.
    return FUNCTIONS[function if function in FUNCTIONS else lookup(function, FUNCTIONS, "policy")]


def policy_names(task: Task) -> list[str]:
    """List the names of the acquisition functions for a task, in the order of registration.

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
