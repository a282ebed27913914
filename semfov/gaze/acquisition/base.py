"""The base class of acquisition functions, and their registry by name."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, MutableMapping
from inspect import Parameter, signature
from typing import ClassVar, Literal, get_args

from torch import Tensor, nn

from semfov.belief.belief import Belief
from semfov.errors import check

Task = Literal["search", "exploration"]


class _Registry(MutableMapping[str, type["AcquisitionFunction"]]):
    """Named acquisition functions, in the order of their registration.

    The baselines (`semfov.baselines`) stand on this room, which imports none of them before all names are listed, or
    one is asked for that is not registered yet.

    Attributes:
        registered: those that are registered so far, by name.
    """

    def __init__(self) -> None:
        self.registered: dict[str, type[AcquisitionFunction]] = {}

    def __getitem__(self, name: str) -> type["AcquisitionFunction"]:
        if name not in self.registered:
            register_baselines()
        return self.registered[name]

    def __setitem__(self, name: str, function: type["AcquisitionFunction"]) -> None:
        self.registered[name] = function

    def __delitem__(self, name: str) -> None:
        del self.registered[name]

    def __iter__(self) -> Iterator[str]:
        register_baselines()
        return iter(self.registered)

    def __len__(self) -> int:
        register_baselines()
        return len(self.registered)


FUNCTIONS = _Registry()


def register_baselines() -> None:
    """Register the acquisition functions of `semfov.baselines`, by importing them."""
    import semfov.baselines.ideal  # noqa: F401


class AcquisitionFunction(nn.Module, ABC):
    """Base of all acquisition functions: the value of fixating each cell next.

    A subclass implements `forward`. The next fixation is the cell of the highest value that was not visited
    (`semfov.gaze.select_fixation`). The function itself may value visited cells too: inhibition of return excludes
    them. A subclass with a `name` is registered when it is defined: `semfov.policies.Policy` and the settings of runs
    refer to it by that name. Its arguments say what it is made from: `target`, `grid` and `model` for the target, the
    cells and a fitted model, and settings of its own. They are given by name; those of its base are among them if it
    passes `**options` on.

    Attributes:
        name: name in settings.
        tasks: tasks that the function is for.
        takes: the arguments that the function is made from, by name.
        needs_model: whether it is made from an observation model.
        by_belief: whether its values depend on the belief.
        by_place: whether it searches by the probability of the target in every cell alone, and so works on any belief.

    Raises:
        InputError: a subclass takes the name of another one, is for other tasks, or has arguments without names.

    >>> import torch
    >>> from semfov import DirichletBelief, Grid, acquisition, policies
    >>> class Background(acquisition.AcquisitionFunction):
    ...     name = "background"
    ...     tasks = ("search", "exploration")
    ...     def forward(self, belief, visited):
    ...         return belief.class_probabilities()[..., 0]
    >>> look = policies.Policy("background")(None, Grid(2, 1, (20, 10)))
    >>> look(DirichletBelief(torch.tensor([[[1.0, 3.0], [1.0, 1.0]]])), torch.zeros(1, 2, dtype=torch.bool))
    tensor([[0.2500, 0.5000]])
    >>> del acquisition.FUNCTIONS["background"]
    """

    name: ClassVar[str] = ""
    tasks: ClassVar[tuple[Task, ...]] = ()
    takes: ClassVar[Mapping[str, Parameter]]
    needs_model: ClassVar[bool]
    by_belief: ClassVar[bool] = True
    by_place: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        parameters = signature(cls).parameters
        kinds = {parameter.kind for parameter in parameters.values()}
        stars = (Parameter.VAR_POSITIONAL, Parameter.VAR_KEYWORD)
        named = {name: parameter for name, parameter in parameters.items() if parameter.kind not in stars}
        # What it passes on by `**` are arguments of its base.
        cls.takes = {**getattr(cls, "takes", {}), **named} if Parameter.VAR_KEYWORD in kinds else named
        cls.needs_model = "model" in cls.takes
        if cls.__dict__.get("name"):
            by_name = Parameter.VAR_POSITIONAL not in kinds or Parameter.VAR_KEYWORD in kinds
            cls._register(by_name)

    @classmethod
    def _register(cls, by_name: bool) -> None:
        """Check the name, the arguments and the tasks of a subclass, and register it."""
        if not cls.__module__.startswith("semfov."):
            register_baselines()  # whose names a user's class may not take
        owner = FUNCTIONS.registered.get(cls.name, cls)
        # A cell of a notebook that is run again defines its class again.
        same = owner.__qualname__ == cls.__qualname__
        check(same, "name", f"one not taken by {owner.__qualname__}", repr(cls.name))
        check(by_name, "__init__", "arguments that can be given by name", f"{cls.__qualname__}{signature(cls)}")
        listed = isinstance(cls.tasks, tuple) and set(cls.tasks) <= set(get_args(Task))
        check(listed, "tasks", f"a tuple of {' and '.join(get_args(Task))}", repr(cls.tasks))
        FUNCTIONS[cls.name] = cls

    @abstractmethod
    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute the value of fixating each cell next.

        Where the gaze is now it does not know: a head alone values what a move costs (`semfov.head.PerSecond`).

        Args:
            belief: belief of B episodes after their last look.
            visited: `(B, X·Y)` boolean, cells that were fixated.

        Returns:
            `(B, X·Y)`; only the order of the values matters, unless the subclass gives them a unit.
        """
