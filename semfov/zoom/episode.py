"""Loops of looks at windows: look, update the belief, and choose the next window."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Generic, TypeVar

from semfov.episode import Forgetting
from semfov.motion import CameraStep, LostScene, Motion
from semfov.zoom.belief import Rates, ZoomBelief
from semfov.zoom.carrying import carried, share_left, share_shown
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, WindowLooks
from semfov.zoom.policy import WindowChoice, WindowValues, best_find, jointly

_Belief = TypeVar("_Belief", bound=ZoomBelief | None)
_StepBelief_co = TypeVar("_StepBelief_co", bound=ZoomBelief | None, covariant=True)

Order = Callable[[Sequence[WindowLook], set[Window]], Sequence[WindowChoice]]
"""Maps the looks that count, the overview first, and their windows, to the windows to look at next with their values;
none ends the episode."""

_Guess = Callable[[Sequence[WindowLook], set[Window], Window | None], WindowChoice | None]
"""Guesses the window to look at after one that is being looked at, which is among the windows; the last argument names
it if it is not in the belief yet."""

_LEAST_LEFT = 0.1  # share of its own window that a look must show of the frame, to count in it

_LEAST_SHOWN = 0.75
"""Share of the frame that the look at the whole must show; below it the camera has moved on, and it is made anew."""


class KeptLook:
    """A look that has not been forgotten, and its place in the present frame of a stream.

    Attributes:
        original: the look, in pixels of the frame in which it was taken.
        current: the look in pixels of the present frame.
        time: seconds of the stream at which it was taken.
        value: the value that it was chosen for.
        number: number of its pass of the detector.
        seconds: time at its end, on the clock of the episode.
        in_view: whether the present frame shows some of its window. One that has left the frame is kept until the
            camera comes back.
    """

    def __init__(self, look: WindowLook, time: float, value: float, number: int = 0, seconds: float = 0.0) -> None:
        self.original = look
        self.current = look
        self.time = time
        self.value = value
        self.number = number
        self.seconds = seconds
        self.in_view = True
        self._motion: Motion | None = None  # of the camera since the look; None as long as it has stood still

    def show(self, current: WindowLook) -> None:
        """Set the place of the look in the next frame; unchanged hints stay the same object."""
        before = self.current.gist
        if before is not None and current.gist is not None and before.equals(current.gist):
            current = replace(current, gist=before)
        self.current = current

    def moved(self, motion: Motion) -> Motion:
        """Add the camera's motion to the next frame, and return the whole motion since the look."""
        self._motion = motion if self._motion is None else self._motion.then(motion)
        return self._motion


def carry_along(looks: list[KeptLook], motion: Motion, lattice: Lattice) -> list[KeptLook]:
    """Move looks to their places in the next frame, by the motion of the camera.

    Args:
        looks: the looks.
        motion: how the camera moved.
        lattice: lattice of the frames.

    Returns:
        The same looks.
    """
    motions = [look.moved(motion) for look in looks]
    for look, current in zip(looks, carried([look.original for look in looks], motions, lattice), strict=True):
        look.show(current)
        look.in_view = share_left(current.window, lattice) >= _LEAST_LEFT
    return looks


class WindowStep(Generic[_StepBelief_co]):
    """One step of an episode: a look, the earlier looks not yet forgotten, and the belief after it.

    Attributes:
        newest: the look.
        kept_looks: the looks that count, the overview first.
        belief: the belief after it, which the next step changes; None without evidence.
    """

    def __init__(
        self,
        newest: KeptLook,
        belief: _StepBelief_co,
        kept_looks: Sequence[KeptLook],
        choose: Callable[[], Sequence[WindowChoice]],
    ) -> None:
        self.newest = newest
        self.kept_looks = kept_looks
        self.belief = belief
        self._choose = choose

    @property
    def look(self) -> WindowLook:
        """The look of this step, in pixels of the frame in which it was taken."""
        return self.newest.original

    @property
    def value(self) -> float:
        """The value for which the look was chosen."""
        return self.newest.value

    @property
    def looks(self) -> list[WindowLook]:
        """The looks whose windows are in view, at their places in the present frame."""
        return [look.current for look in self.kept_looks if look.in_view]

    @cached_property
    def choices(self) -> Sequence[WindowChoice]:
        """The windows to look at next and their values, computed when first read."""
        return self._choose()

    def choose_anew(self) -> None:
        """Forget the chosen windows, because the scene has changed or frames have passed."""
        self.__dict__.pop("choices", None)

    @property
    def next_value(self) -> float:
        """Value of the best look that remains, in a search its chance of a hit; 0 if none remains."""
        return self.choices[0][1] if self.choices else 0.0


class _Recent(Generic[_Belief]):
    """The looks of an episode that count, the overview first, and the belief of them.

    Invariant: `belief` holds the looks of `kept`, where they lie in the present frame, and nothing else; `windows` are
    their windows. `lost` has the looks of a scene that the camera has lost and may find again. `lacks_overview` tells
    whether the overview is too old, or shows too little of the frame; it is made anew then. `step` is the last step.
    """

    def __init__(self, belief: _Belief, source: WindowLooks, forgetting: Forgetting | None) -> None:
        self.belief = belief
        self.source = source
        self.forgetting = forgetting
        self.kept: list[KeptLook] = []
        self.lost: LostScene[KeptLook] = LostScene()
        self.windows: set[Window] = set()
        # Set by `_forget` at each look of a stream; read by `_next_choices`, which then chooses the overview.
        self.lacks_overview = False
        self.step: WindowStep[_Belief] | None = None

    @property
    def looks(self) -> list[WindowLook]:
        """The looks that count, where they lie in the present frame."""
        return [look.current for look in self.kept]

    def add(self, look: WindowLook, value: float) -> KeptLook:
        """Add a look at the present frame, and forget those that it replaces and those that are too old."""
        newest = KeptLook(look, self.source.time, value)
        count = len(self.kept)
        self.kept.append(newest)
        if self.forgetting is not None:
            self._forget(self.forgetting.span)
        # A belief cannot forget a single look, so it is made of those that are left.
        if len(self.kept) <= count:
            self._believe_anew()
        else:
            self.windows.add(look.window)
            if self.belief is not None:
                self.belief.add(look)
        return newest

    def follow(self, camera: CameraStep) -> None:
        """Carry the looks along with the camera, or set them aside where the frame fits none before."""
        self.kept = self.lost.follow(self.kept, camera, partial(carry_along, lattice=self.source.lattice))
        self._believe_anew()
        # Else the window that was chosen after the last look is looked at: a camera moves little in a frame.
        is_other_scene = camera.motion is None or camera.recovered is not None
        if self.step is not None and is_other_scene:
            self.step.choose_anew()

    def _believe_anew(self) -> None:
        """Make the belief of the looks that count."""
        self.windows = {look.current.window for look in self.kept}
        if self.belief is not None:
            self.belief.clear()
            for look in self.kept:
                self.belief.add(look.current)

    def _forget(self, span: float) -> None:
        """Forget looks that the newest one replaces, and those older than a span in seconds."""
        newest = self.kept[-1]
        if self._is_new_overview(newest):
            # The overview stays the first of the looks that count.
            self.kept = [newest, *self.kept[1:-1]]
        overview = self.kept[0]
        # An old overview is kept until there is a new one, as all other looks are predicted from it.
        counting = []
        for look in self.kept:
            is_recent = newest.time - look.time <= span
            is_replaced = look.current.window == newest.current.window
            if look in (overview, newest) or (is_recent and not is_replaced):
                counting.append(look)
        self.kept = counting
        # Judged for the next frame, in which the new overview would be made.
        at_next_frame = newest.time + self.source.passed
        is_old = at_next_frame - overview.time > span
        self.lacks_overview = is_old or share_shown(overview.current.window, self.source.lattice) < _LEAST_SHOWN

    def _is_new_overview(self, newest: KeptLook) -> bool:
        """Tell whether the newest look was taken at the window of the overview again."""
        overview = self.kept[0]
        return newest is not overview and newest.original.window == overview.original.window


def look_by_look(
    source: WindowLooks,
    order: Order,
    belief: _Belief,
    *,
    hints: bool = True,
    forgetting: Forgetting | None = None,
    guess: _Guess | None = None,
) -> Iterator[WindowStep[_Belief]]:
    """Look at the whole picture, and then at the windows of an ordered list to its end.

    The next windows are chosen after a step was taken; the guessed one is resampled by a second thread during the look
    before. In a stream a look counts for the time in which half of its evidence would fade, or until the next look at
    its window. Where the order has no window left, the one that was looked at longest ago is looked at again.
    """
    recent = _Recent(belief, source, forgetting)
    source.carry = recent.follow
    choose = partial(_next_choices, recent, order)
    choices = choose()
    is_still = forgetting is None
    while choices:
        # Which window is next can be guessed where the belief waits for one look, after the overview.
        is_single = len(choices) == 1 and bool(recent.kept)
        if guess is not None and is_still and is_single:
            source.meanwhile = partial(_resample_likely, recent, guess, choices[0][0])
        windows = [window for window, _ in choices]
        looks = source.see(windows, hints=hints)
        for look, (_, value) in zip(looks, choices, strict=True):
            newest = recent.add(look, value)
            recent.step = step = WindowStep(newest, belief, tuple(recent.kept), choose)
            yield step
        choices = step.choices


def _next_choices(recent: _Recent[_Belief], order: Order) -> Sequence[WindowChoice]:
    """Choose the next windows: the overview, then those of the order; in a stream there is always one."""
    overview = Window.overview(recent.source.lattice)
    if not recent.kept:
        return [(overview, float("inf"))]
    choices = order(recent.looks, recent.windows)
    if recent.forgetting is None:
        return choices
    if not choices:
        oldest = min(recent.kept, key=lambda look: look.time)
        return [(oldest.original.window, 0.0)]
    if recent.lacks_overview:
        # With the value of the look that it displaces, which a search reads as its chance of a hit.
        return [(overview, choices[0][1])]
    return choices


def _resample_likely(recent: _Recent[_Belief], guess: _Guess, window: Window) -> None:
    """Resample the window that is likely to follow the one that is being looked at."""
    unknown: Window | None = window
    if recent.belief is not None and not window.points_closer(recent.source.lattice):
        # Whatever the look shows, the belief about where to look next is known.
        recent.belief.discount(window)
        unknown = None
    likely = guess(recent.looks, recent.windows | {window}, unknown)
    if likely is not None:
        recent.source.prepare(likely[0])


def look_for(
    source: WindowLooks, evidence: GlimpseEvidence, target: int, *, forgetting: Forgetting | None = None
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for one object of a class, look by look, until nothing is left to look at."""
    return search_windows(source, ZoomBelief(source.lattice, evidence, target, source.blank), forgetting=forgetting)


def search_windows(
    source: WindowLooks, belief: ZoomBelief, *, forgetting: Forgetting | None = None
) -> Iterator[WindowStep[ZoomBelief]]:
    r"""Look for one object of the belief's class, at the windows where most such objects are expected.

    The value of a look is the chance of a hit, :math:`1 - e^{-v}` for a Poisson number of objects with the mean v.
    """

    def best(looks: Sequence[WindowLook], done: set[Window]) -> Sequence[WindowChoice]:
        choice = best_find(belief, done, belief.foresight)
        return [] if choice is None else [(choice[0], -math.expm1(-choice[1]))]

    return look_by_look(source, best, belief, forgetting=forgetting, guess=_likely_find(belief))


def find_everything(
    source: WindowLooks,
    evidence: Rates,
    target: int | None = None,
    *,
    batch: int = 1,
    min_gain: float = 0.0,
    forgetting: Forgetting | None = None,
    known: Callable[[int], WindowValues] | None = None,
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for all objects of one class, or of every class, until no look is expected to find enough.

    Up to `batch` windows are chosen jointly and looked at together; no other episode has such batches. `known` gives by
    level what a look at each window brings for objects that are known.
    """
    belief = ZoomBelief(source.lattice, evidence, target or 0, source.blank)

    def best(looks: Sequence[WindowLook], done: set[Window]) -> Sequence[WindowChoice]:
        chosen = jointly(lambda visited: best_find(belief, visited, belief.foresight, known=known), belief, done, batch)
        return [choice for choice in chosen if choice[1] > min_gain]

    return look_by_look(
        source,
        best,
        belief,
        hints=False,
        forgetting=forgetting,
        guess=_likely_find(belief),
    )


def _likely_find(belief: ZoomBelief) -> _Guess:
    """Guess that the window follows in which most objects are expected."""
    return lambda _, done, beside: best_find(belief, done, belief.foresight, beside=beside)
