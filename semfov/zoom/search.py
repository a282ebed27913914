"""Searching and exploring pictures larger than a detector's input."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from semfov.decision import Decision
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.context import WindowContext
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance, Glances, Window, on_lattice
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import Objects, merge
from semfov.zoom.policy import Choice, best_find, best_hit, best_slice, jointly


@dataclass(frozen=True)
class ZoomPath:
    """The record of a search in, or an exploration of, a large picture.

    Attributes:
        lattice: of the picture.
        classes: names of the classes, background first.
        target: class that was searched for; None for an exploration.
        glances: looks in order, the overview first.
        values: what each was worth when it was chosen; the overview's is infinite.
        objects: found, merged from all glances.
        decision: what a search decided; None where everything was to be found.
    """

    lattice: Lattice
    classes: tuple[str, ...]
    target: int | None
    glances: tuple[Glance, ...]
    values: tuple[float, ...]
    objects: Objects
    decision: Decision | None = None

    @property
    def passes(self) -> int:
        """Passes of the detector."""
        return len(self.glances)


def look_for(
    glances: Glances,
    evidence: GlimpseEvidence,
    target: int,
    *,
    confirm: float = 0.3,
    slices: Sequence[Window] | None = None,
    closest: bool = False,
    context: WindowContext | None = None,
) -> Iterator[tuple[Glance, float, float]]:
    """Look for one object of a class, glance by glance; ends when a look confirms it, or nothing is left to look at.

    Args:
        glances: of the picture.
        evidence: learned, by magnification.
        target: class 1..K.
        confirm: score that confirms it.
        slices: if given, only looks at these confirm it; else looks at all magnifications do.
        closest: only looks at the largest magnification confirm it.
        context: what else is known of what is beside what.

    Yields:
        The glance, what it was worth, and what the best look is worth now: the probability that it shows the target.
    """
    belief, done = ZoomBelief(glances.lattice, evidence, target, context), set[Window]()
    window, worth = on_lattice(glances.lattice, (0, 0, 0)), float("inf")
    allowed = None if slices is None else set(slices)
    while True:
        glance = glances.see([window])[0]
        done.add(window)
        belief.add(glance)
        choice = best_hit(belief, done, closest=closest) if slices is None else best_slice(belief, slices, done)
        yield glance, worth, 0.0 if choice is None else choice[1]
        last = window.level == glances.lattice.levels - 1
        confirms = window in allowed if allowed is not None else last or not closest
        if choice is None or (confirms and float(glance.show[target - 1]) >= confirm):
            return
        window, worth = choice


def find_everything(
    glances: Glances, evidence: GlimpseEvidence, target: int | None = None, *, batch: int = 1, worth: float = 0.0
) -> Iterator[tuple[Glance, float]]:
    """Look for all objects of a class, or of any, glance by glance, until no look is worth its price.

    Args:
        glances: of the picture.
        evidence: learned, by magnification.
        target: class 1..K; None for any.
        batch: looks that are chosen, and taken, together.
        worth: new objects that a look must be expected to find.

    Yields:
        The glance, and how many new objects it was expected to find.
    """
    belief, done = ZoomBelief(glances.lattice, evidence, target or 0), set[Window]()
    chosen: list[Choice] = [(on_lattice(glances.lattice, (0, 0, 0)), float("inf"))]
    while chosen:
        for glance, (_, value) in zip(glances.see([window for window, _ in chosen]), chosen, strict=True):
            done.add(glance.window)
            belief.add(glance)
            yield glance, value
        chosen = jointly(lambda taken: best_find(belief, taken, evidence.foresight), belief, done, batch)
        chosen = [choice for choice in chosen if choice[1] > worth]


def search(
    glances: Glances,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    target: int,
    *,
    passes: int = 24,
    confirm: float = 0.3,
    give_up: float = 0.005,
    context: WindowContext | None = None,
) -> ZoomPath:
    """Search a picture for one object of a class, and decide.

    It is `found` when a look shows it with a score of `confirm`; `absent` when every window's probability of showing it
    is below `give_up`; `undecided` when the passes are spent. The probability of the decision is that score, or the
    best window's probability.

    Args:
        glances: of the picture.
        evidence: learned, by magnification.
        classes: names, background first.
        target: class 1..K.
        passes: of the detector, at most.
        confirm: see above.
        give_up: see above.
        context: as for `look_for`.
    """
    seen: list[Glance] = []
    values: list[float] = []
    outcome: Decision | None = None
    for glance, value, ahead in look_for(glances, evidence, target, confirm=confirm, context=context):
        seen.append(glance)
        values.append(value)
        score = float(glance.show[target - 1])
        if score >= confirm:
            place = glance.detections.scores[0, :, target]
            box = glance.detections.boxes[0, int(place.argmax())] if len(place) else None
            outcome = Decision("found", score, None, box)
            break
        if ahead < give_up:
            outcome = Decision("absent", ahead)
            break
        if len(seen) == passes:
            outcome = Decision("undecided", ahead)
            break
    assert outcome is not None
    objects = merge(seen, target)
    return ZoomPath(glances.lattice, classes, target, tuple(seen), tuple(values), objects, outcome)


def find_all(
    glances: Glances,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    target: int | None = None,
    *,
    passes: int = 24,
    batch: int = 1,
    worth: float = 0.01,
) -> ZoomPath:
    """Find all objects of a class, or of any, with so many passes of the detector at most.

    Arguments as for `search` and `find_everything`.
    """
    seen: list[Glance] = []
    values: list[float] = []
    with torch.inference_mode():
        for glance, value in find_everything(glances, evidence, target, batch=batch, worth=worth):
            seen.append(glance)
            values.append(value)
            if len(seen) == passes:
                break
    return ZoomPath(glances.lattice, classes, target, tuple(seen), tuple(values), merge(seen, target))
