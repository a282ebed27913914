"""Verification: the probability of a target at a place after a closer look at the place."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor, nn

from semfov.detection.detections import Detections
from semfov.errors import InputError
from semfov.io.pretrained import PretrainedForEye, fit_again_command
from semfov.io.schema import Field, Schema
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.matching import box_iou
from semfov.observation.thresholds import THRESHOLDS, DecidingModule, Thresholds, thresholds_of, thresholds_record
from semfov.precision import without_autocast

CLOSER_FEATURES = 7  # number of features of a closer look (`closer_features`)
_MATCHED = 0.3  # least overlap (intersection over union) of a detection with a box at which it shows the same object

TRUE_CELLS = "true_cells"
"""Key of the metadata: whether the searches of the fit had true probabilities of cells."""

_FLOOR = 1e-3


class Verification(DecidingModule, PretrainedForEye):
    r"""Probabilities of a target after a closer look: that it is at the examined place, and that the image holds it.

    A search that is about to end with `found` looks closely at the place first (`semfov.Eye.close_up`). Both
    probabilities are logistic regressions on the features φ of that look and of the belief before it
    (`closer_features`):

    .. math:: \operatorname{logit} P = w^\top \phi + b

    (Target verification follows guidance in models of human search, too: Malcolm and Henderson, 2009, *The effects of
    target template specificity on visual search in real-world scenes*.)

    Args:
        thresholds: thresholds at which searches decide; None if none were chosen. `confirm` is the least probability
            that the target is at the examined place, for `found`. `place` is the least probability of a cell that is
            worth a closer look. `stop_below` has the same meaning as without closer looks.
        metadata: JSON values saved with the model: `detector` and `sensor` (the settings it was fitted for), and
            `true_cells` (`check_searching`).

    >>> model = Verification()  # not fitted yet
    >>> model(torch.zeros(2, 7)).shape
    torch.Size([2, 2])
    """

    kind: ClassVar[str] = "verification"
    title: ClassVar[str] = "model of verification"
    shipped: ClassVar[Path] = Path(__file__).parent / "models" / "verification"
    schema: ClassVar[Schema] = Schema(
        {
            "linear.weight": Field((2, CLOSER_FEATURES), low=-1e3, high=1e3),
            "linear.bias": Field((2,), low=-1e3, high=1e3),
        },
        {"thresholds": THRESHOLDS},
    )

    def __init__(self, *, thresholds: Thresholds | None = None, metadata: Mapping[str, Any] | None = None) -> None:
        super().__init__()
        self.metadata = dict(metadata or {})
        self.thresholds = thresholds
        self.linear = nn.Linear(CLOSER_FEATURES, 2)

    def forward(self, features: Tensor) -> Tensor:
        """Compute the log odds after closer looks.

        Args:
            features: `(..., 7)` (`closer_features`).

        Returns:
            `(..., 2)`, log odds that the target is at the place, and that the image holds it.
        """
        with without_autocast(features):
            return self.linear(features.to(self.linear.weight))

    def check_searching(self, searching: FovealObservationModel) -> None:
        """Check that the model was fitted to the same kind of cell probabilities as a search has.

        Args:
            searching: the observation model of the search.

        Raises:
            InputError: only one of both has probabilities that a fit has made true.
        """
        kinds = {True: "true probabilities of cells", False: "probabilities of cells as the belief has them"}
        read = bool(self.metadata.get(TRUE_CELLS, False))
        if read != searching.true_cells:
            raise InputError(
                f"verification: expected one that was fitted to a search with {kinds[searching.true_cells]}, got one "
                f"of {kinds[read]}; fit again with python -m train.fit_search and python -m train.fit_verification, or "
                f"fit both into a folder, which takes the place of the file: {fit_again_command(searching.metadata)}"
            )

    def _record(self) -> dict[str, Any]:
        """List what a file holds beside tensors."""
        return {"thresholds": thresholds_record(self.thresholds)}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """Make the model of a file."""
        model = cls(thresholds=thresholds_of(record["thresholds"]), metadata=record["metadata"])
        model.load_state_dict(tensors)
        return model


def closer_features(
    presence: float, cell: float, evidence: float, closer: Detections, box: Tensor, target: int
) -> tuple[Tensor, Tensor]:
    r"""Compute seven features of a closer look at a place, and the box of the target in it.

    Detection m has the largest score times overlap o with the examined box. The features are the logits, within 0.001,
    of: the picture and the cell holding the target, and the evidence there, all before; :math:`s_{mt} o_m`; the highest
    score of the target in the look, in faint candidates, too; :math:`\max_l o_l \max_{k \ne t} s_{lk}`; and
    :math:`s_{mt}`.

    Args:
        presence: probability that the picture holds the target, before the look.
        cell: probability that the cell of the place holds it.
        evidence: evidence there, as a probability.
        closer: detections of the look, a batch of one, boxes in pixels of the picture.
        box: the examined place, `(4,)`.
        target: class 1..K.

    Returns:
        Features `(7,)`, and the box of the target `(4,)`: that of detection m if it overlaps the examined one enough.
    """
    before = [presence, cell, evidence]
    boxes = closer.boxes[0][closer.mask[0]]  # (L, 4)
    scores = closer.scores[0][closer.mask[0]]  # (L, K+1)
    if not len(boxes):
        nothing = [0.0, 0.0, 0.0, 0.0]
        return box.new_tensor([*before, *nothing]).logit(_FLOOR), box
    score = scores[:, target]
    best, overlap = _best_detection(boxes, score, box)
    # The largest score of another class than the target; background is none.
    no_rivals = torch.tensor([0, target], device=scores.device)
    rival = scores.index_fill(1, no_rivals, 0).amax(-1)
    after = [
        float(score[best] * overlap[best]),
        float(closer.highest[0, target]),
        float((overlap * rival).max()),
        float(score[best]),
    ]
    shown = boxes[best] if float(overlap[best]) >= _MATCHED else box
    return shown.new_tensor([*before, *after]).logit(_FLOOR), shown


def _best_detection(boxes: Tensor, scores: Tensor, box: Tensor) -> tuple[int, Tensor]:
    r"""Find the detection that best shows the target in a box, :math:`m = \arg\max_l s_l o_l`.

    Args:
        boxes: `(L, 4)`, of the detections.
        scores: s, `(L,)`, of the target.
        box: the box, `(4,)`.

    Returns:
        The number m of the detection, and the overlaps o of all of them with the box, `(L,)`.
    """
    overlap = box_iou(boxes, box[None])[:, 0]
    return int((scores * overlap).argmax()), overlap


def follow_target(box: Tensor, detections: Detections, target: int) -> Tensor:
    """Move the box of a target to the middle of the detection that best shows it, and keep its size.

    Args:
        box: `(4,)`, from a closer look, which sizes objects better.
        detections: those of another look, a batch of one.
        target: class 1..K.

    Returns:
        The box `(4,)`, where it was if no detection overlaps it enough.
    """
    boxes = detections.boxes[0][detections.mask[0]]
    scores = detections.scores[0][detections.mask[0], target]
    if not len(boxes):
        return box
    best, overlap = _best_detection(boxes, scores, box)
    if float(overlap[best]) < _MATCHED:
        return box
    # The mean shift of two opposite corners is that of the middle.
    shift = (boxes[best] - box).view(2, 2).mean(0)
    return box + shift.repeat(2)
