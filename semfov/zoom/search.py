"""Loops over the windows of a picture: for one object of a class, or for all objects."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from semfov.zoom.belief import Rates, ZoomBelief
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance, Glances, Window, on_lattice
from semfov.zoom.policy import Choice, best_find, best_hit, best_slice, jointly


class Turn(NamedTuple):
    """A turn of a search: one look.

    Attributes:
        glance: result of the look.
        worth: value of the look when it was chosen.
        ahead: value of the best look that is left after it.
        belief: belief after it.
    """

    glance: Glance
    worth: float
    ahead: float
    belief: ZoomBelief


def look_for(
    glances: Glances,
    evidence: GlimpseEvidence,
    target: int,
    *,
    confirm: float = 0.3,
    slices: Sequence[Window] | None = None,
    closest: bool = False,
) -> Iterator[Turn]:
    """Look for one object of a class, look by look, until a look confirms it or nothing is left to look at.

    Args:
        glances: source of looks at the picture.
        evidence: learned evidence by magnification.
        target: class 1..K.
        confirm: score from which on a look confirms the target.
        slices: windows that can confirm the target; None lets windows of all magnifications confirm it.
        closest: whether only windows of the last level can confirm it.

    Yields:
        Each turn.
    """
    belief, done = ZoomBelief(glances.lattice, evidence, target), set[Window]()
    window, worth = on_lattice(glances.lattice, (0, 0, 0)), float("inf")
    allowed = None if slices is None else set(slices)
    while True:
        glance = glances.see([window])[0]
        done.add(window)
        belief.add(glance)
        choice = best_hit(belief, done, closest=closest) if slices is None else best_slice(belief, slices, done)
        yield Turn(glance, worth, 0.0 if choice is None else choice[1], belief)
        last = window.level == glances.lattice.levels - 1
        confirms = window in allowed if allowed is not None else last or not closest
        if choice is None or (confirms and float(glance.show[target - 1]) >= confirm):
            return
        window, worth = choice


def find_everything(
    glances: Glances, evidence: Rates, target: int | None = None, *, batch: int = 1, worth: float = 0.0
) -> Iterator[tuple[Glance, float]]:
    """Look for all objects of a class, or of all classes, look by look, until no look promises enough.

    Args:
        glances: source of looks at the picture.
        evidence: learned evidence by magnification.
        target: class 1..K; None for all classes.
        batch: number of windows that are chosen jointly and looked at together.
        worth: the exploration ends when no look is expected to find more new objects than this.

    Yields:
        The result of each look, and the number of new objects that it was expected to find.
    """
    belief, done = ZoomBelief(glances.lattice, evidence, target or 0), set[Window]()
    chosen: list[Choice] = [(on_lattice(glances.lattice, (0, 0, 0)), float("inf"))]
    while chosen:
        looks = glances.see([window for window, _ in chosen], hints=False)
        for glance, (_, value) in zip(looks, chosen, strict=True):
            done.add(glance.window)
            belief.add(glance)
            yield glance, value
        chosen = jointly(lambda taken: best_find(belief, taken, belief.foresight), belief, done, batch)
        chosen = [choice for choice in chosen if choice[1] > worth]
