"""Episodes over the windows of a picture: choose windows, look, update the belief, until nothing is left to look at."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Generic, TypeVar

from semfov.zoom.belief import ZoomBelief
from semfov.zoom.glances import Glance, Glances, Window, overview
from semfov.zoom.policy import Choice

_Belief = TypeVar("_Belief", ZoomBelief, None)

Order = Callable[[Sequence[Glance], set[Window]], Sequence[Choice]]
"""Maps the looks so far, and their windows, to the windows to look at next with their values; none ends the episode."""


class Turn(Generic[_Belief]):
    """One step of an episode: a look, its value when it was chosen, and the belief after it.

    Attributes:
        glance: result of the look.
        worth: value of the look when it was chosen.
        belief: belief after it; None in episodes without one.
    """

    def __init__(self, glance: Glance, worth: float, belief: _Belief, choose: Callable[[], Sequence[Choice]]) -> None:
        self.glance, self.worth, self._choose = glance, worth, choose
        self.belief: _Belief = belief

    @cached_property
    def choices(self) -> Sequence[Choice]:
        """The windows to look at next and their values, chosen when they are first asked for."""
        return self._choose()

    @property
    def ahead(self) -> float:
        """Value of the best look that is left after it; 0 if none is left."""
        return self.choices[0][1] if self.choices else 0.0


def look_by_look(
    glances: Glances,
    order: Order,
    belief: _Belief,
    *,
    ends: Callable[[Glance], bool] = lambda glance: False,
    hints: bool = True,
) -> Iterator[Turn[_Belief]]:
    """Look at the whole picture, and then at the windows of an order, until it has none left.

    The next windows are chosen after a turn was taken: a caller that wants no further turn spends no time on it.

    Args:
        glances: source of looks at the picture.
        order: chooses the windows; those that it chooses together are looked at together.
        belief: belief that every look updates; None keeps none.
        ends: tells whether a look ends the episode.
        hints: whether hints are needed in windows of the last level, too (`Glances.see`).

    Yields:
        Each turn.

    Example::

        def row_by_row(looks, windows):
            return [(slices[len(looks) - 1], 0.0)] if len(looks) <= len(slices) else []

        for turn in look_by_look(glances, row_by_row, None):
            print(turn.glance.window)
    """
    seen, done = list[Glance](), set[Window]()
    choices: Sequence[Choice] = [(overview(glances.lattice), float("inf"))]
    while choices:
        looks = glances.see([window for window, _ in choices], hints=hints)
        for glance, (_, worth) in zip(looks, choices, strict=True):
            seen.append(glance)
            done.add(glance.window)
            if belief is not None:
                belief.add(glance)
            turn = Turn(glance, worth, belief, lambda: order(seen, done))
            yield turn
            if ends(glance):
                return
        choices = turn.choices
