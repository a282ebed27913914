"""Searching and exploring pictures that are larger than the detector's input."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.target_evidence import Thresholds
from semfov.decision import MOST, OUTCOMES, Decision, Verifier, settle
from semfov.detection.detections import Detections
from semfov.paths.endings import Ending
from semfov.zoom.belief import Rates, ZoomBelief
from semfov.zoom.closer import CandidateBoxes, WindowLook, look_closely
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance, Glances, Window, on_lattice
from semfov.zoom.objects import merge
from semfov.zoom.path import ZoomPath
from semfov.zoom.policy import Choice, best_find, best_hit, best_slice, jointly
from semfov.zoom.tally import Tally

DEFAULTS = Thresholds(0.9, 0.005)
"""Thresholds of searches whose evidence has none."""


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


def search(
    glances: Glances,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    target: int,
    *,
    passes: int = 24,
    confirm: float | None = None,
    give_up: float | None = None,
    closer: int = MOST,
) -> ZoomPath:
    """Search a picture for one object of a class and decide whether it is there.

    Places that seem to hold the target are looked at closely, and the target is `found` when it is probable enough at
    such a place (`semfov.decision.Verifier`). Without closer looks it is `found` when the picture holds it with
    a probability of at least `confirm` and a detection shows it (`semfov.decision.settle`).

    When the value of every look that is left is below `give_up`, or all closer looks were made, the target is `absent`
    if its probability is below one half, and the search is `undecided` otherwise. It is also `undecided` when the
    passes are used up.

    Args:
        glances: source of looks at the picture.
        evidence: learned evidence by magnification.
        classes: names of the classes, background first.
        target: class 1..K.
        passes: largest number of passes of the detector, closer looks included.
        confirm: probability from which on the target is found: with closer looks, that it is at the place; otherwise,
            that the picture holds it. None takes the threshold of the evidence.
        give_up: probability that a look shows the target, below which no look is worth a pass; None takes the threshold
            of the evidence.
        closer: largest number of closer looks; 0 decides without them, as does evidence without fitted verification.

    Returns:
        The looks, the objects of the class, and the decision.
    """
    thresholds = (evidence.thresholds or DEFAULTS).changed(give_up=give_up)
    seen: list[Glance] = []
    values: list[float] = []

    def close_up(box: Tensor) -> Detections:
        seen.append(look_closely(glances, box))
        return seen[-1].detections

    verifier, model = None, evidence.verification
    if closer and model is not None and model.thresholds is not None:
        places, at = CandidateBoxes(target, thresholds.confirm), model.thresholds.changed(confirm, thresholds.give_up)
        verifier = Verifier(model, places, close_up, at, closer)
    else:
        thresholds = thresholds.changed(confirm)
    tally: Tally | None = None
    ended, presence = 0, None
    for glance, value, ahead, belief in look_for(glances, evidence, target, confirm=float("inf")):
        tally = tally or Tally(belief)
        tally.add(glance)
        seen.append(glance)
        values.append(value)
        presence = None
        if tally.looked or ahead < thresholds.give_up:  # otherwise no probability ends the search
            presence = tally.presence(ahead)
            if verifier is None:
                state = torch.tensor([presence]), torch.tensor([tally.looked]), torch.tensor([ahead])
                ended = int(settle(*state, thresholds))
            else:
                room, look = passes - len(seen), WindowLook(glance.detections, len(seen), presence, tally.best, ahead)
                verifier.see(look, last=ahead == 0 or room <= 1)
                values += [place.probability for place in verifier.look_closely(room)]
                ended = verifier.outcome()
        if ended or len(seen) == passes:
            break
    assert tally is not None
    if verifier is not None and verifier.looks:
        decision = verifier.decision(over=ended > 0)
    else:
        presence = tally.presence(ahead) if presence is None else presence
        decision = Decision(OUTCOMES[ended], presence, None, tally.box if OUTCOMES[ended] == "found" else None)
    decided = ended > 0 or decision.outcome == "found"
    ending: Ending = "decision" if decided else "passes" if len(seen) == passes else "windows"
    return ZoomPath(
        lattice=glances.lattice,
        classes=classes,
        target=target,
        glances=tuple(seen),
        values=tuple(values),
        objects=merge(seen, target),
        decision=decision,
        ending=ending,
        closer=() if verifier is None else tuple(verifier.looks),
    )


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
    """Find all objects of a class, or of all classes, with a limited number of passes of the detector.

    Args:
        glances: source of looks at the picture.
        evidence: learned evidence by magnification.
        classes: names of the classes, background first.
        target: class 1..K; None for all classes.
        passes: largest number of passes of the detector.
        batch: number of windows that are chosen jointly and looked at together.
        worth: the exploration ends when no look is expected to find more new objects than this.

    Returns:
        The looks and the objects.
    """
    seen: list[Glance] = []
    values: list[float] = []
    ending: Ending = "price"
    with torch.inference_mode():
        for glance, value in find_everything(glances, evidence, target, batch=batch, worth=worth):
            seen.append(glance)
            values.append(value)
            if len(seen) == passes:
                ending = "passes"
                break
    return ZoomPath(
        lattice=glances.lattice,
        classes=classes,
        target=target,
        glances=tuple(seen),
        values=tuple(values),
        objects=merge(seen, target),
        ending=ending,
    )
