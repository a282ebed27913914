"""Fit the verification of targets in large pictures by closer looks, on searches of mosaics."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data.mosaics import Mosaics
from semfov.decision import OUTCOMES, SAME, Verifier, settle
from semfov.detection.detections import Detections
from semfov.fit.verification_decisions import Ended, Verified, choose_confirm
from semfov.fit.verification_fit import Examined, FittedVerification, fit
from semfov.fit.verification_report import report
from semfov.fit.zoom_decision import searches_of
from semfov.observation.matching import box_iou
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom.closer import CandidateBoxes, WindowLook, look_closely
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance

AFTER = (1, 3, 5, 8, 12, 16, 24)
"""Numbers of looks after which places are examined for the fit."""

_EACH = 3  # places examined after some looks
_LEAST = 0.03  # least probability of these places


class Limits(Protocol):
    """Settings of the fit (see `FitZoomConfig`)."""

    @property
    def sought(self) -> int:
        """Number of present classes, and of absent classes, to search for in each mosaic."""
        ...

    @property
    def passes(self) -> int:
        """Maximum number of passes of the detector in a search."""
        ...

    @property
    def place(self) -> float:
        """Least probability of a place that is worth a closer look when no other look follows."""
        ...

    @property
    def false_alarms(self) -> float:
        """Maximum share of absent targets that may be reported as found."""
        ...

    @property
    def surest(self) -> float:
        """Upper limit of the probability from which on a target counts as found."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the choice of classes."""
        ...


@dataclass(frozen=True)
class Turned:
    """A search after a look.

    Attributes:
        glance: the look.
        presence: probability that the picture holds the target.
        best: highest score of the target in any look.
        ahead: value of the best look that is left.
        box: `(4,)`, box of the detection with the highest score of the target; None as long as no detection shows it.
    """

    glance: Glance
    presence: float
    best: float
    ahead: float
    box: Tensor | None

    def look(self, number: int) -> WindowLook:
        """The look for a verifier, with the number of looks up to it."""
        return WindowLook(self.glance.detections, number, self.presence, self.best, self.ahead)


@dataclass(frozen=True)
class Sought:
    """A class to search for in a mosaic, and all looks of the search.

    Attributes:
        mosaic: number of the mosaic.
        looks: the stored looks at it.
        target: the class, 1..K.
        boxes: `(M, 4)`, annotated boxes of the class; none if it is absent.
        turns: the search after each look.
    """

    mosaic: int
    looks: StoredGlances
    target: int
    boxes: Tensor
    turns: tuple[Turned, ...]

    @property
    def present(self) -> bool:
        """Whether the mosaic holds the class."""
        return len(self.boxes) > 0

    def close_up(self, box: Tensor) -> Detections:
        """Look closely at a box `(4,)`; returns the detections, a batch of one."""
        return look_closely(self.looks, box).detections

    def right(self, box: Tensor) -> bool:
        """Whether a box `(4,)` is that of an annotated object of the class."""
        return self.present and float(box_iou(box[None], self.boxes).max()) >= SAME


@torch.inference_mode()
def sought_in(
    model: GlimpseEvidence, mosaics: Mosaics, opened: Sequence[StoredGlances], config: Limits, title: str
) -> Iterator[Sought]:
    """Search every mosaic, without closer looks (`semfov.fit.zoom_decision.searches_of`).

    Decisions do not move the gaze, so all of them can be made along the same looks.

    Args:
        model: the evidence that guides the search.
        mosaics: the mosaics.
        opened: the stored looks at each mosaic.
        config: the settings.
        title: label of the progress bar.

    Yields:
        Each search with all its looks.
    """
    searches = searches_of(
        model, mosaics, opened, classes=config.sought, passes=config.passes, seed=config.seed, title=title
    )
    for index, annotation, target, turns in searches:
        told = [
            Turned(turn.glance, tally.presence(turn.ahead), tally.best, turn.ahead, tally.box if tally.looked else None)
            for turn, tally in turns
        ]
        yield Sought(index, opened[index], target, annotation.boxes[annotation.labels == target], tuple(told))


@torch.inference_mode()
def examine(searches: Sequence[Sought]) -> Examined | None:
    """Look closely at the most evident places after some looks of every search.

    Args:
        searches: the searches.

    Returns:
        The closer looks, all in one fold; None if no place is right, or none is wrong.
    """
    rows: list[tuple[Tensor, bool, bool, int]] = []
    for sought in searches:
        for count in (each for each in AFTER if each <= len(sought.turns)):
            boxes = CandidateBoxes(sought.target, _LEAST)
            for number, turn in enumerate(sought.turns[:count], 1):
                boxes.see(turn.look(number))
            for _ in range(_EACH):
                candidate = boxes.due(_LEAST, last=True)
                if candidate is None:
                    break
                features, box = boxes.examine(candidate, sought.close_up)
                rows.append((features, sought.right(box), sought.present, 0))
    if len({right for _, right, _, _ in rows}) < 2:
        return None
    columns = list(zip(*rows, strict=True))
    return Examined(torch.stack(columns[0]), *(torch.tensor(column) for column in columns[1:]))


@torch.inference_mode()
def verify(
    searches: Sequence[Sought], model: Verification, evidence: GlimpseEvidence, config: Limits
) -> Iterator[Verified]:
    """Make all closer looks of searches, whatever they show.

    Args:
        searches: the searches.
        model: gives the probabilities after closer looks.
        evidence: the evidence, with thresholds.
        config: the settings.

    Yields:
        The searches.
    """
    assert evidence.thresholds is not None
    give_up, likely = evidence.thresholds.give_up, evidence.thresholds.confirm
    always = Thresholds(1.0, give_up, config.place)
    for sought in searches:
        verifier, count = Verifier(model, CandidateBoxes(sought.target, likely), sought.close_up, always), 0
        for turn in sought.turns:
            count += 1
            room = config.passes - count
            verifier.see(turn.look(count), last=room <= 1)
            count += len(verifier.look_closely(room))
            if verifier.over or count >= config.passes:
                break
        yield Verified(
            photograph=sought.mosaic,
            present=sought.present,
            spare=False,
            places=tuple((look.place, sought.right(look.box)) for look in verifier.looks),
            ends=tuple(look.number + 1 for look in verifier.looks if look.number is not None),
            presence=verifier.presence,
            looks=count,
            unverified=unverified(sought, evidence.thresholds),
        )


def unverified(sought: Sought, thresholds: Thresholds) -> Ended:
    """End of a search without closer looks: whether the box that it found is right (None: not found), and its looks."""
    for count, turn in enumerate(sought.turns, 1):
        state = torch.tensor([turn.presence]), torch.tensor([turn.box is not None]), torch.tensor([turn.ahead])
        ended = int(settle(*state, thresholds))
        if ended:
            found = turn.box if OUTCOMES[ended] == "found" else None
            return (None if found is None else sought.right(found)), count
    return None, len(sought.turns)


def fit_closer(
    model: GlimpseEvidence,
    mosaics: Mapping[str, Mosaics],
    opened: Mapping[str, Sequence[StoredGlances]],
    config: Limits,
) -> str:
    """Fit the verification on some mosaics, choose its threshold on held-out ones, and add it to the model.

    Args:
        model: the evidence, with thresholds.
        mosaics: the mosaics `searched`, to fit to, and `judged`, of held-out photographs.
        opened: the stored looks at each of them.
        config: the settings.

    Returns:
        The report in Markdown, which says so if there are too few places to fit to.
    """
    searches = {
        kind: list(sought_in(model, mosaics[kind], opened[kind], config, title))
        for kind, title in (("searched", "looking closely"), ("judged", "looking closely at held-out mosaics"))
    }
    known, examined = (examine(searches[kind]) for kind in ("searched", "judged"))
    looks_of = [*opened["searched"], *opened["judged"]]
    for looks in looks_of:
        looks.save()
    model.verification = None
    if known is None or examined is None:
        return "None, since there are no places that hold the target, or none that do not.\n"
    fitted = fit(known, known.fold == 0)
    held_out = list(verify(searches["judged"], fitted, model, config))
    confirm = choose_confirm(held_out, config.false_alarms, config.surest)
    assert model.thresholds is not None
    fitted.thresholds = Thresholds(confirm, model.thresholds.give_up, config.place)
    model.verification = fitted
    for looks in looks_of:
        looks.save()
    how = f"The model was fitted to {len(known.fold)} closer looks at mosaics of other photographs."
    pictures = f"{len(opened['judged'])} mosaics of held-out photographs"
    return report(FittedVerification(fitted, [fitted], examined, held_out), pictures, how)[0]
