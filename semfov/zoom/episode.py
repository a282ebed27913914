"""Episodes over the windows of a picture: look, update the belief and choose, for one object of a class, or for all."""

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Generic, TypeVar

from semfov.episode import Forgetting
from semfov.zoom.belief import Rates, ZoomBelief
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance, Glances, Window
from semfov.zoom.policy import WindowChoice, best_find, best_hit, jointly

_Belief = TypeVar("_Belief", ZoomBelief, None)

Order = Callable[[Sequence[Glance], set[Window]], Sequence[WindowChoice]]
"""Maps the looks that count, the overview first, and their windows, to the windows to look at next with their values;
none ends the episode."""

_Guess = Callable[[Sequence[Glance], set[Window], Window | None], WindowChoice | None]
"""Guesses the window to look at after one that is being looked at, which is among the windows; the last argument names
it if it is not in the belief yet."""


class WindowStep(Generic[_Belief]):
    """One step of an episode: a look, its value when it was chosen, and the belief after it."""

    def __init__(
        self,
        glance: Glance,
        worth: float,
        belief: _Belief,
        looks: Sequence[Glance],
        choose: Callable[[], Sequence[WindowChoice]],
    ) -> None:
        self.glance, self.worth, self.looks, self._choose = glance, worth, looks, choose
        self.belief: _Belief = belief

    @cached_property
    def choices(self) -> Sequence[WindowChoice]:
        """The windows to look at next and their values, chosen when they are first asked for."""
        return self._choose()

    @property
    def ahead(self) -> float:
        """Value of the best look that is left after it; 0 if none is left."""
        return self.choices[0][1] if self.choices else 0.0


class _Recent(Generic[_Belief]):
    """The looks of an episode that count, and the belief of them."""

    def __init__(self, belief: _Belief, forgetting: Forgetting | None) -> None:
        self.belief, self.forgetting = belief, forgetting
        self.looks: list[Glance] = []
        self.windows: set[Window] = set()
        self.renewed = False
        self.frames: list[float] = []

    def add(self, glance: Glance, frame: float) -> None:
        """Add a look at a frame, and forget those that it replaces and those that are too old."""
        self.looks.append(glance)
        self.frames.append(frame)
        if self.forgetting is not None and self._forgets(glance, frame):
            self.windows = {look.window for look in self.looks}
            if self.belief is not None:
                self.belief.clear()
                for look in self.looks:
                    self.belief.add(look)
            return
        self.windows.add(glance.window)
        if self.belief is not None:
            self.belief.add(glance)

    def _forgets(self, glance: Glance, frame: float) -> bool:
        """Forget the looks that no longer count; returns whether any were forgotten."""
        assert self.forgetting is not None
        first, span = self.looks[0].window, self.forgetting.span
        again = glance.window in self.windows
        dated: list[tuple[float, Glance]] = list(zip(self.frames, self.looks, strict=True))
        if again and glance.window == first:
            dated = [dated[-1], *dated[1:-1]]
        # An old overview is kept until there is a new one, as all other looks are predicted from it.
        recent = [
            (when, look)
            for when, look in dated
            if look is glance or (look.window != glance.window and (look.window == first or frame - when <= span))
        ]
        self.frames, self.looks = [when for when, _ in recent], [look for _, look in recent]
        self.renewed = frame + 1 - self.frames[0] > span
        return len(recent) < len(dated) or again


def look_by_look(
    glances: Glances,
    order: Order,
    belief: _Belief,
    *,
    hints: bool = True,
    forgetting: Forgetting | None = None,
    guess: _Guess | None = None,
) -> Iterator[WindowStep[_Belief]]:
    """Look at the whole picture, and then at the windows of an order, until it has none left.

    The next windows are chosen after a turn was taken; the guessed one is resampled by a second thread during the look
    before. In a stream a look counts for the frames in which half of its evidence would fade, or until the next look at
    its window. Where the order has no window left, the one that was looked at longest ago is looked at again.
    """
    recent, first = _Recent(belief, forgetting), Window.overview(glances.lattice)

    def choose() -> Sequence[WindowChoice]:
        choices = order(recent.looks, recent.windows)
        if forgetting is not None and (recent.renewed or not choices):
            oldest = min(zip(recent.frames, recent.looks, strict=True), key=lambda dated: dated[0])[1].window
            return [(first, choices[0][1])] if choices else [(oldest, 0.0)]
        return choices

    def prepare(window: Window) -> None:
        assert guess is not None
        beside: Window | None = window
        if belief is not None and not window.points_closer(glances.lattice):
            # Whatever the look shows, the belief about where to look next is known.
            belief.discount(window)
            beside = None
        if likely := guess(recent.looks, recent.windows | {window}, beside):
            glances.prepare(likely[0])

    choices: Sequence[WindowChoice] = [(first, float("inf"))]
    while choices:
        if guess is not None and forgetting is None and len(choices) == 1 and recent.looks:
            glances.meanwhile = partial(prepare, choices[0][0])
        looks = glances.see([window for window, _ in choices], hints=hints)
        for glance, (_, worth) in zip(looks, choices, strict=True):
            recent.add(glance, glances.frame)
            turn = WindowStep(glance, worth, belief, tuple(recent.looks), choose)
            yield turn
        choices = turn.choices


def look_for(
    glances: Glances, evidence: GlimpseEvidence, target: int, *, forgetting: Forgetting | None = None
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for one object of a class, look by look, until nothing is left to look at."""
    belief = ZoomBelief(glances.lattice, evidence, target, glances.blank)
    return look_by_look(
        glances,
        lambda _, done: jointly(partial(best_hit, belief), belief, done, 1),
        belief,
        forgetting=forgetting,
        guess=lambda _, done, beside: best_hit(belief, done, beside=beside),
    )


def find_everything(
    glances: Glances,
    evidence: Rates,
    target: int | None = None,
    *,
    batch: int = 1,
    worth: float = 0.0,
    forgetting: Forgetting | None = None,
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for all objects of a class, or of all classes, look by look, until no look promises enough."""
    belief = ZoomBelief(glances.lattice, evidence, target or 0, glances.blank)

    def best(looks: Sequence[Glance], done: set[Window]) -> Sequence[WindowChoice]:
        chosen = jointly(lambda visited: best_find(belief, visited, belief.foresight), belief, done, batch)
        return [choice for choice in chosen if choice[1] > worth]

    return look_by_look(
        glances,
        best,
        belief,
        hints=False,
        forgetting=forgetting,
        guess=lambda _, done, beside: best_find(belief, done, belief.foresight, beside=beside),
    )
