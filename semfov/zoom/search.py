"""Searching and exploring pictures that are larger than the detector's input."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch

from semfov.belief.target_evidence import Thresholds
from semfov.decision import MOST, OUTCOMES, Decision, settle
from semfov.paths.endings import Ending
from semfov.zoom.belief import Rates, ZoomBelief
from semfov.zoom.closer import ZoomVerifier
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
    such a place (`semfov.zoom.closer.ZoomVerifier`). Without closer looks it is `found` when the picture holds it with
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
    verifier, model = None, evidence.verification
    if closer and model is not None and model.thresholds is not None:
        verifier = ZoomVerifier(model, glances, target, model.thresholds.changed(confirm), thresholds.confirm, closer)
    else:
        thresholds = thresholds.changed(confirm)
    seen: list[Glance] = []
    values: list[float] = []
    tally: Tally | None = None
    ended, presence = 0, None
    for glance, value, ahead, belief in look_for(glances, evidence, target, confirm=float("inf")):
        tally = tally or Tally(belief)
        tally.add(glance)
        seen.append(glance)
        values.append(value)
        if verifier is not None:
            verifier.suspects.see(glance)
        presence, over = None, ahead < thresholds.give_up
        if tally.looked or over:  # otherwise no probability ends the search
            presence = tally.presence(ahead)
            if verifier is None:
                state = torch.tensor([presence]), torch.tensor([tally.looked]), torch.tensor([ahead])
                ended = int(settle(*state, thresholds))
            else:
                room = passes - len(seen)
                last = over or ahead == 0 or room <= 1
                for look, chance in verifier(presence, tally.best, len(seen), room, over=last):
                    seen.append(look)
                    values.append(chance)
                ended = verifier.outcome(presence, over=over)
        if ended or len(seen) == passes:
            break
    assert tally is not None
    presence = tally.presence(ahead) if presence is None else presence
    box, place = (tally.box if OUTCOMES[ended] == "found" else None), None
    if verifier is not None:
        if not ended and OUTCOMES[verifier.outcome(presence, over=True)] == "found":
            ended = OUTCOMES.index("found")
        presence = verifier.presence(presence)
        if OUTCOMES[ended] == "found":
            best = verifier.best()
            presence, box, place = max(presence, best.place), best.box, best.place
    ending: Ending = "decision" if ended else "passes" if len(seen) == passes else "windows"
    return ZoomPath(
        lattice=glances.lattice,
        classes=classes,
        target=target,
        glances=tuple(seen),
        values=tuple(values),
        objects=merge(seen, target),
        decision=Decision(OUTCOMES[ended], presence, None, box, place),
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
