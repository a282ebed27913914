"""The settings of each task: arguments in Python, options of the command, and read by the episode.

The fields of these classes are the keywords of `ActivePerception.search`, `find_all`, `explore` and `live`, and the
options of the commands, which take their names, types and help from here. In all of them None is the default that suits
the kind of look and the models of the agent.

                      LookSettings    StartSettings    DecisionSettings    its own
    SearchSettings         x                x                 x            boxes
    FindSettings           x                                               min_gain, score_threshold, batch
    ExploreSettings        x                x                              min_gain, score_threshold, policy
    StreamSettings                          x                 x            how, rate, passes, score_threshold, color
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, dataclass, field, fields
from inspect import cleandoc
from typing import Annotated, Any, Literal, TypeVar, get_args

from torch import Tensor

from semfov.data.inputs import Color
from semfov.errors import InputError, check, lookup
from semfov.io.ranges import CheckedSettings, Form, Probability, Range, Seconds, Seed, Shifts, Weight
from semfov.kinds import KindName, LookKind

__all__ = [
    "DecisionSettings",
    "ExploreSettings",
    "FindSettings",
    "LookSettings",
    "SearchSettings",
    "StartSettings",
    "StreamSettings",
]

How = Literal["auto", KindName]
"""Kind of look, or `auto` for the one that suits the picture."""

Start = int | tuple[int, int] | None
"""First cell of a fovea, by its number or its column and row, or first action of a head; None for the usual one."""

OnLook = Callable[[Any], object]
"""Function that is called after each look with the record so far; the episode ends if it returns False."""

MOST_PASSES = 1_000_000
"""Largest number of passes that can be asked for."""

FirstCell = Annotated[int | tuple[int, int], Form("a cell", "as column,row (5,5) or as its number (47)")]
Passes = Annotated[int, Range(1, MOST_PASSES)]
MostCloserLooks = Annotated[int, Range(0, 100)]
PriorShare = Annotated[float | Literal["fit"], Range(above=0, below=1, noun="a share, such as 0.15,", word="fit")]
Rate = Annotated[float, Range(0, 100)]

_Function = TypeVar("_Function", bound=Callable[..., object])
_Value = TypeVar("_Value")

_KINDS = "kinds"  # metadata of a field: the kinds of look that the setting is for, first the one that messages suggest
_INSTEAD = "instead"  # metadata of a field: what a message suggests for other kinds of look


def value_or(setting: _Value | None, usual: _Value) -> _Value:
    """Return the value of a setting, or a default if it is None."""
    return usual if setting is None else setting


def _only_for(*kinds: KindName, instead: str) -> Mapping[str, object]:
    """Make the metadata of a setting that means nothing to other kinds of look."""
    return {_KINDS: kinds, _INSTEAD: instead}


@dataclass(frozen=True)
class LookSettings(CheckedSettings):
    """Settings of all episodes with a picture: the kind of look, and limits. The first limit that is reached ends it.

    Args:
        how: kind of look: `fovea`, `windows`, `head` (in a panorama, which is twice as wide as high, or another picture
            in front of the viewer), or `auto` for the one that suits the picture.
        passes: largest number of passes of the detector, closer looks included (None: 24 for windows, 40 for a head).
        shifts: largest number of gaze shifts of a fovea (None: 30 for a search, 20 otherwise; with `passes` no limit).
        seconds: longest time in seconds for a picture on this machine.
        duration: in a scene, longest time in seconds for the movements of eye and head (None: 30).
        on_look: function that is called after each look with the record so far; returning False ends the episode.

    Raises:
        InputError: a value is out of range, or the kind of look is unknown.

    >>> LookSettings(passes=8)
    LookSettings(how='auto', passes=8, shifts=None, seconds=None, duration=None, on_look=None)
    """

    how: How = "auto"
    passes: Passes | None = None
    shifts: Shifts | None = field(default=None, metadata=_only_for("fovea", instead="passes="))
    seconds: Seconds | None = None
    duration: Seconds | None = field(default=None, metadata=_only_for("head", instead="seconds="))
    on_look: OnLook | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        lookup(self.how, get_args(How), "kind of look")
        check(self.on_look is None or callable(self.on_look), "on_look", "a function of the record", self.on_look)

    def check_suitable(self, kind: LookKind) -> None:
        """Raise `InputError` for a setting that a kind of look does not have; the message says what to use instead.

        Args:
            kind: the kind of look.

        Raises:
            InputError: a setting is given that is not for this kind.
        """
        for setting in fields(self):
            value = getattr(self, setting.name)
            kinds, instead = suitable_kinds(setting)
            if value is not None and kind.name not in kinds:
                raise InputError(
                    f"{setting.name}: expected none for a picture that is looked at by {kind.looks_by}, got {value}; "
                    f"use {instead}, or how={kinds[0]!r}"
                )


@dataclass(frozen=True)
class StartSettings(CheckedSettings):
    """Settings of the first look, and of what is drawn at random.

    Args:
        start: first cell of a fovea, by its number row by row or as `(column, row)`, or first action of a head
            (`semfov.head.views.Views`); None draws the cell at random, and looks straight ahead.
        seed: seed of the generator that draws the start and breaks ties.

    Raises:
        InputError: a value is out of range.

    >>> StartSettings((5, 5))
    StartSettings(start=(5, 5), seed=0)
    """

    start: FirstCell | None = field(default=None, metadata=_only_for("fovea", "head", instead="none"))
    seed: Seed = 0


@dataclass(frozen=True)
class DecisionSettings(CheckedSettings):
    """Settings of the decision of a search (`semfov.decision`).

    Args:
        confirm: least probability of the target for `found`: with closer looks, that it is at the place; otherwise,
            that the picture holds it (None: the threshold that was chosen when the model was fitted, or a score of 0.5
            for agents without a fitted belief).
        stop_below: chance of a new hit below which the search stops (None: the threshold of the model).
        closer: largest number of closer looks, each of which enlarges a window around a place that seems to hold the
            target to the detector's input, in one pass (None: 3 in a photograph, as many as there are passes in a large
            picture, 2 for a fovea); 0: none.
        prior: share of the pictures that hold the target, such as 0.15 (None: one half); `fit` takes the share in the
            searches that the models were fitted to.

    Raises:
        InputError: a value is out of range.

    >>> DecisionSettings(closer=0)
    DecisionSettings(confirm=None, stop_below=None, closer=0, prior=None)
    """

    confirm: Probability | None = None
    stop_below: Probability | None = None
    closer: MostCloserLooks | None = field(default=None, metadata=_only_for("fovea", "windows", instead="confirm"))
    prior: PriorShare | None = None

    @property
    def given_share(self) -> float | None:
        """The prior if it is a number; None otherwise."""
        return None if self.prior == "fit" else self.prior


@dataclass(frozen=True)
class SearchSettings(DecisionSettings, LookSettings, StartSettings):
    """Settings of a search of a picture for a class (`ActivePerception.search`).

    Args:
        boxes: `(M, 4)`, true boxes `(x1, y1, x2, y2)` of the target in pixels of a photograph; the search then ends
            without a decision, with the gaze on a cell that a box meets.

    Raises:
        InputError: a value is out of range, or the kind of look is unknown.

    >>> SearchSettings(confirm=0.9, passes=8).confirm
    0.9
    """

    # Tensors are compared element by element, so that settings with them could not be compared as a whole.
    boxes: Tensor | Sequence[Sequence[float]] | None = field(
        default=None, compare=False, metadata=_only_for("fovea", instead="passes")
    )


@dataclass(frozen=True)
class FindSettings(LookSettings):
    """Settings of the search for all objects of a picture (`ActivePerception.find_all`).

    Args:
        min_gain: least expected gain of another look; below it the episode ends. For windows it counts new objects
            (None: 0.01), for a head cells that are newly classified right (None: 0). A photograph is looked at wholly
            by windows, whatever it is.
        score_threshold: probability from which on an object is listed in windows (None: 0.5); without fitted models and
            otherwise its score (None: 0.3).
        batch: number of windows that are chosen jointly and pass the detector together. It counts in large pictures
            with fitted models alone, and means nothing in photographs, for a fovea and for a head.

    Raises:
        InputError: a value is out of range, or the kind of look is unknown.

    >>> FindSettings(min_gain=0.05).batch
    1
    """

    min_gain: Weight | None = field(default=None, metadata=_only_for("windows", "head", instead="passes"))
    score_threshold: Probability | None = None
    batch: Annotated[int, Range(1, MOST_PASSES)] = 1


@dataclass(frozen=True)
class ExploreSettings(LookSettings, StartSettings):
    """Settings of an exploration of a picture (`ActivePerception.explore`).

    Args:
        min_gain: least expected gain of another look; below it the episode ends. For a fovea with the semantic map
            it counts cells that are newly classified right (None: 0.1), for a head likewise (None: 0), for windows new
            objects (None: 0.01). 0 makes all looks. A photograph is looked at wholly by windows, whatever it is.
        score_threshold: probability from which on an object is listed in windows (None: 0.5); without fitted models and
            otherwise its score (None: 0.3).
        policy: `people` moves a fovea as people move their gaze (`semfov.gaze.Viewer`); None as the agent does.

    Raises:
        InputError: a value is out of range, or the kind of look is unknown.

    >>> ExploreSettings(policy="people", how="fovea").policy
    'people'
    """

    min_gain: Weight | None = None
    score_threshold: Probability | None = None
    policy: str | None = field(default=None, metadata=_only_for("fovea", instead="none"))

    def __post_init__(self) -> None:
        super().__post_init__()
        check(self.policy in (None, "people"), "policy", "'people', or None", self.policy)


@dataclass(frozen=True)
class StreamSettings(DecisionSettings, StartSettings):
    """Settings of looks at a stream of frames (`ActivePerception.live`).

    Args:
        how: kind of look: `fovea`, `windows`, or `auto`: windows, or a fovea where frames are small and the agent has
            no evidence for photographs or `start` is given.
        rate: rate at which evidence fades, per second; 0: never (None: 2.5 for a fovea, 0.75 for windows).
        passes: passes of the detector at each frame, for windows (None: 1).
        confirm: least probability of the target for `found`: with closer looks, that it is at the place (None: the
            threshold of the model).
        stop_below: chance of a new hit below which no closer look is made (None: that of the belief alone, as a belief
            that fades can reach it, or with rate 0 that of a search).
        closer: largest number of closer looks in the time until half of the evidence has faded (None: 2 for a fovea, 3
            for windows in small frames, no limit for windows in large ones); 0: none.
        prior: how often the target is there: the share of the frames that hold it (None: one half); `fit` takes that of
            the searches that the models were fitted to.
        score_threshold: probability from which on an object is listed in windows (None: 0.5); for a curve of precision
            over recall give a lower one.
        color: order of the channels of frames that are arrays or tensors, `rgb`, or `bgr` as OpenCV reads them.

    Raises:
        InputError: a value is out of range, or the kind of look or the order of channels is unknown.

    >>> StreamSettings(rate=0).prior is None
    True
    """

    how: How = "auto"
    rate: Rate | None = None
    passes: Passes | None = None
    score_threshold: Probability | None = None
    color: Color = "rgb"

    def __post_init__(self) -> None:
        super().__post_init__()
        lookup(self.how, get_args(How), "kind of look")
        lookup(self.color, get_args(Color), "order of channels")


_ENTRY = re.compile(r"(?m)^    (\w+): .*(?:\n {8}.*)*")  # a setting in a docstring, with its help


def help_of(kind: type[CheckedSettings]) -> dict[str, str]:
    """Read the help of settings from the docstrings of their classes.

    Args:
        kind: dataclass of settings, whose help of an inherited setting replaces that of its base.

    Returns:
        For each setting, its entry of the section `Args`.

    >>> help_of(StartSettings)["seed"]
    '    seed: seed of the generator that draws the start and breaks ties.'
    """
    entries: dict[str, str] = {}
    # From the base down, so that what a class says of an inherited setting replaces what its base says.
    for base in reversed(kind.__mro__):
        section = cleandoc(base.__doc__ or "").partition("Args:\n")[2].partition("\n\n")[0]
        entries |= {match[1]: match[0] for match in _ENTRY.finditer(section)}
    return {setting.name: entries[setting.name] for setting in fields(kind)}


def documented_by(kind: type[CheckedSettings]) -> Callable[[_Function], _Function]:
    """Decorate a function whose keywords are settings, and add their help to its docstring.

    Args:
        kind: dataclass of the settings.

    Returns:
        The decorator, which changes the docstring alone.
    """

    def document(function: _Function) -> _Function:
        if function.__doc__ is not None:  # python -OO keeps none
            arguments, following, rest = cleandoc(function.__doc__).partition("\n\nReturns:")
            function.__doc__ = "\n".join([arguments, *help_of(kind).values()]) + following + rest
        return function

    return document


def suitable_kinds(setting: Field[Any]) -> tuple[tuple[str, ...], str]:
    """Find the kinds of look that have a setting.

    Args:
        setting: a field of the settings of a task.

    Returns:
        The names of the kinds, first the one to suggest, and what to use instead for the others.

    >>> suitable_kinds(SearchSettings.__dataclass_fields__["shifts"])
    (('fovea',), 'passes=')
    """
    return setting.metadata.get(_KINDS, get_args(KindName)), setting.metadata.get(_INSTEAD, "none")
