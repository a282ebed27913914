"""Verification of the target in a stream of frames: closer looks take frames of their own, and their verdicts fade."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import MATCHED, Verification, match
from semfov.decision.candidates import SAME, CandidatePlace
from semfov.decision.closer_look import CloserLook
from semfov.decision.evidence import cell_of
from semfov.decision.rule import Decision, surely
from semfov.decision.verifier import MOST, Examiner
from semfov.detection.detections import Detections
from semfov.episode import Forgetting, Step
from semfov.observation.matching import box_iou

_SPANS = 2  # spans of `Forgetting` after which nothing is left of a verdict: a quarter of its evidence
_FLOOR = 1e-6


@dataclass(frozen=True)
class Verdict:
    """What a closer look has told, some frames ago.

    Attributes:
        look: the closer look; its box and its cell follow the target (`follow`).
        age: number of frames since then.
    """

    look: CloserLook
    age: int = 0


class LiveVerifier(Examiner):
    r"""Decides a search in a stream of frames, with closer looks that take the place of looks.

    A frame costs one pass of the detector. After each frame the verifier says which place the next frame is spent on
    (`candidate`), by the rules of `semfov.decision.Verifier`. The next frame is a look of the fovea if there is none.

    The probabilities of a closer look fade towards the belief. With the rate r of `Forgetting`, after a frames

    .. math:: \operatorname{logit} P_a = e^{-ra} \operatorname{logit} P_0 + (1 - e^{-ra}) \operatorname{logit} B

    where B is the present probability by the belief: of the target in the cell of the place, or in the image. That of a
    place never rises above :math:`P_0`, so a place is found by closer looks alone. After :math:`\ln 2 / r` frames the
    place may be examined again. After twice as many frames the verdict is forgotten.

    If r is not 0 the scene may move, and the boxes of the verdicts follow the detections of each look (`follow`).

    Args:
        model: gives the probabilities after closer looks.
        grid: the cells.
        target: class 1..K.
        forgetting: forgetting between frames.
        thresholds: see `Verification`; None takes those of the model.
        most: largest number of closer looks in :math:`\ln 2 / r` frames.

    Raises:
        InputError: no thresholds are given and the model has none, or `most` is out of range.

    Example::

        verifier.wait()  # before each frame
        if verifier.candidate is None:
            verifier.see(step := next(steps))
        else:
            verifier.look(step, partial(eye.close_up, frame))
        print(verifier.decision(step))
    """

    def __init__(
        self,
        model: Verification,
        grid: Grid,
        target: int,
        forgetting: Forgetting,
        thresholds: Thresholds | None = None,
        most: int = MOST,
    ) -> None:
        super().__init__(model, grid, target, thresholds, most, forgetting)
        self.forgetting = forgetting
        self.verdicts: list[Verdict] = []
        self.candidate: CandidatePlace | None = None
        self._ended = False

    def wait(self) -> None:
        """Let the time of a frame pass. Call it before every frame."""
        self.candidates.wait()
        aged = (replace(verdict, age=verdict.age + 1) for verdict in self.verdicts)
        self.verdicts = [verdict for verdict in aged if verdict.age <= _SPANS * self.forgetting.span]

    def see(self, step: Step) -> None:
        """Take in a look of the fovea, and choose what the next frame is spent on.

        Args:
            step: the step of this frame.
        """
        self.candidates.see(step.detections)
        if self.forgetting.rate:
            self.verdicts = [self._followed(verdict, step.detections) for verdict in self.verdicts]
        self._plan(step)

    def look(self, step: Step, close_up: Callable[[Tensor], Detections]) -> CloserLook:
        """Look closely at the candidate, and choose what the next frame is spent on.

        Args:
            step: the last look of the fovea, in an earlier frame.
            close_up: looks closely at a box `(4,)` in this frame.

        Returns:
            The closer look.
        """
        assert self.candidate is not None
        look = self.examine(step, self.candidate, close_up)
        # A place that was free to be examined again has a new verdict now.
        self.verdicts = [old for old in self.verdicts if self._recent(old) or not _same(old.look, look)]
        self.verdicts.append(Verdict(look))
        self._plan(step)
        return look

    def decision(self, step: Step) -> Decision:
        """Make the decision at this frame.

        Args:
            step: the last look of the fovea.

        Returns:
            `found` as long as the probability of a place is at least `confirm`; `absent` or `undecided`, as for a
            search that ends (`Verifier`); and `undecided` before that.
        """
        here = float(step.belief.presence(self.target))
        recent = [each for each in self.verdicts if self._recent(each)]
        presence = max((self._faded(each.look.presence, here, each.age) for each in recent), default=here)
        places = [(self._place(each, step.belief), each.look) for each in self.verdicts]
        place, best = max(places, key=lambda pair: pair[0], default=(0.0, None))
        if best is not None and place >= self.thresholds.confirm:
            return Decision("found", max(presence, place), best.cell, best.box, place)
        return Decision("absent" if self._ended and presence < 0.5 else "undecided", presence)

    def _plan(self, step: Step) -> None:
        """Choose the candidate for the next frame, and find out whether a search would end here."""
        recent, over = [each for each in self.verdicts if self._recent(each)], self.over(step)
        spent = len(recent) >= self.most
        sure = any(self._place(each, step.belief) >= surely(self.thresholds.confirm) for each in recent)
        self.candidate = None if spent or sure else self.due(step, over=over)
        self._ended = self.candidate is None and (spent or over)

    def _followed(self, verdict: Verdict, seen: Detections) -> Verdict:
        """The verdict at the place to which a look has followed its target."""
        box = follow(verdict.look.box, seen, verdict.look.target)
        return replace(verdict, look=replace(verdict.look, box=box, cell=cell_of(box, self.candidates.grid)))

    def _recent(self, verdict: Verdict) -> bool:
        """Whether at least half of the evidence of a closer look is left."""
        return verdict.age <= self.forgetting.span

    def _place(self, verdict: Verdict, belief: Belief) -> float:
        """Probability that the target is still at the place of a closer look."""
        told, here = verdict.look.place, float(belief.probability(self.target)[0, verdict.look.cell])
        return min(told, self._faded(told, here, verdict.age))

    def _faded(self, told: float, here: float, age: int) -> float:
        """A probability that fades towards that of the belief."""
        weight = self.forgetting.keep**age
        if weight == 1:
            return told
        before, now = torch.tensor([told, here], dtype=torch.float64).logit(_FLOOR)
        return float((weight * before + (1 - weight) * now).sigmoid())


def follow(box: Tensor, seen: Detections, target: int) -> Tensor:
    """Move the box of a target to the middle of the detection that best shows it (`semfov.belief.verification.match`).

    The box keeps its size, because a closer look measures it better than a look of the fovea.

    Args:
        box: `(4,)`, the box.
        seen: detections of a look, a batch of one.
        target: class 1..K.

    Returns:
        The box `(4,)`, unmoved if no detection overlaps it by `MATCHED`.

    >>> seen = Detections(torch.tensor([[[2.0, 0, 12, 8]]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1).bool())
    >>> follow(torch.tensor([0.0, 0.0, 8.0, 8.0]), seen, 1)
    tensor([ 3.,  0., 11.,  8.])
    """
    shown = seen.mask[0]
    boxes, scores = seen.boxes[0][shown], seen.scores[0][shown, target]
    if not len(boxes):
        return box
    best, overlap = match(boxes, scores, box)
    if float(overlap[best]) < MATCHED:
        return box
    shift = (boxes[best] - box).view(2, 2).mean(0)
    return box + shift.repeat(2)


def _same(one: CloserLook, other: CloserLook) -> bool:
    """Whether two closer looks show the same place."""
    return one.cell == other.cell or float(box_iou(one.box[None], other.box[None])) >= SAME
