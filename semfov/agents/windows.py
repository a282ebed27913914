"""An agent for pictures larger than its detector's input."""

from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.target_evidence import Thresholds
from semfov.data.classes import class_index
from semfov.data.inputs import ImageLike
from semfov.data.large import LargePicture, picture_size
from semfov.decision import MOST_CLOSER, OUTCOMES, Decision, Verifier, check_thresholds, settle
from semfov.detection.detections import Detections
from semfov.detection.load import load_detector
from semfov.errors import check, check_number, check_whole
from semfov.paths.endings import Ending
from semfov.paths.windows import ZoomPath
from semfov.zoom.closer import CandidateBoxes, WindowLook, look_closely
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import Cut, WindowEye
from semfov.zoom.facts import SearchFacts
from semfov.zoom.glances import Glance, Glances, LiveGlances
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge
from semfov.zoom.search import find_everything, look_for

_LIMIT = 1_000_000
"""Limit of passes and batches, more than any picture has windows."""

_Picture = LargePicture | ImageLike

DEFAULTS = Thresholds(0.9, 0.005)
"""Thresholds of searches whose evidence has none."""


class ZoomAgent(nn.Module):
    """Search and explore pictures that are larger than the detector's input.

    Each look is a window at a magnification and costs one pass of the detector. The agent looks where it expects to
    find most, as closely as it takes to find it.

    Args:
        eye: resamples a window and detects in it.
        evidence: predicts from a look what closer looks will find.

    Raises:
        InputError: the evidence was made for other classes, or for another detector.

    Example::

        agent = ZoomAgent.recommended("yolox-nano")
        path = agent.find_all("harbour.tif", "person", passes=16)
        print(path.objects.boxes, path.passes)
    """

    def __init__(self, eye: WindowEye, evidence: GlimpseEvidence) -> None:
        super().__init__()
        kinds = len(eye.detector.classes)
        check(evidence.classes == kinds, "evidence", f"one for the detector's {kinds} classes", evidence.classes)
        evidence.check_compatible(eye.settings())
        self.eye = eye
        self.evidence = evidence

    @classmethod
    def recommended(cls, name: str = "yolox-nano", *, finest: float = 1.0, cut: Cut = "keep", **options: Any) -> Self:
        """Create the agent with the evidence that is shipped for a detector.

        Args:
            name: name of the detector.
            finest: largest magnification, in canvas pixels per picture pixel.
            cut: treatment of boxes that the border of a window cuts (`WindowEye`).
            **options: options of `semfov.load_detector`.

        Returns:
            The agent, in evaluation mode and without gradients.

        Raises:
            InputError: no evidence is shipped for a detector of this name.
            DataError: the weights cannot be downloaded, or they are damaged.
        """
        eye = WindowEye(load_detector(name, **options), finest=finest, cut=cut)
        evidence = GlimpseEvidence.from_pretrained(eye.detector.name)
        return cls(eye, evidence).eval().requires_grad_(False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first."""
        return ("background", *self.eye.detector.classes)

    def pays(self, picture: _Picture) -> bool:
        """Tell whether a picture is large enough for windows to pay.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.

        Returns:
            True where there are two octaves or more to zoom in: the longer side of the picture is at least four times
            that of the detector's input.
        """
        return pays(picture_size(picture), self.eye.detector.input_size)

    def search(
        self,
        picture: _Picture,
        target: str | int,
        *,
        passes: int = 24,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = MOST_CLOSER,
    ) -> ZoomPath:
        """Search for one object of a class and decide whether the picture holds one (`search_windows`).

        The recommended agent looks closely at places that seem to hold the class before it says `found`
        (`semfov.zoom.closer`).

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            target: name or index (1..K) of the class.
            passes: largest number of passes of the detector, closer looks included.
            confirm: the class counts as found when the probability reaches this value: with closer looks, that it is at
                the place; otherwise, that the picture holds it. None takes the threshold of the evidence.
            give_up: the search ends when no look shows the class with a probability of at least this value; None takes
                the threshold of the evidence.
            closer: largest number of closer looks, 0 to 100. 0 decides without them, as does evidence without fitted
                verification.

        Returns:
            The looks, the objects of the class, and the decision.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
            DataError: the file cannot be read.
        """
        check_whole(passes, "passes", 1, _LIMIT)
        check_thresholds(confirm, give_up)
        check_whole(closer, "closer", 0, 100)
        index = class_index(target, self.classes[1:], "target")
        with torch.inference_mode():
            return search_windows(
                self._open(picture),
                self.evidence,
                self.classes,
                index,
                passes=passes,
                confirm=confirm,
                give_up=give_up,
                closer=closer,
            )

    def find_all(
        self, picture: _Picture, target: str | int, *, passes: int = 24, batch: int = 1, worth: float = 0.01
    ) -> ZoomPath:
        """Find all objects of a class (`semfov.agents.windows.find_all`).

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            target: name or index (1..K) of the class.
            passes: largest number of passes of the detector.
            batch: number of windows that are chosen jointly and pass the detector together.
            worth: the exploration ends when no look is expected to find more new objects than this.

        Returns:
            The looks and the objects of the class.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
            DataError: the file cannot be read.
        """
        return self._find(picture, class_index(target, self.classes[1:], "target"), passes, batch, worth)

    def explore(self, picture: _Picture, *, passes: int = 24, batch: int = 1, worth: float = 0.01) -> ZoomPath:
        """Find all objects of all classes.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            passes: largest number of passes of the detector.
            batch: number of windows that are chosen jointly and pass the detector together.
            worth: the exploration ends when no look is expected to find more new objects than this.

        Returns:
            The looks and the objects.

        Raises:
            InputError: an argument does not fit.
            DataError: the file cannot be read.
        """
        return self._find(picture, None, passes, batch, worth)

    def _find(self, picture: _Picture, target: int | None, passes: int, batch: int, worth: float) -> ZoomPath:
        check_whole(passes, "passes", 1, _LIMIT)
        check_whole(batch, "batch", 1, _LIMIT)
        check_number(worth, "worth", 0, float("inf"))
        return find_all(
            self._open(picture), self.evidence, self.classes, target, passes=passes, batch=batch, worth=worth
        )

    def _open(self, picture: _Picture) -> LiveGlances:
        return LiveGlances(self.eye, self.eye.open(picture))


def pays(size: tuple[int, int], canvas: tuple[int, int]) -> bool:
    """Tell whether a picture is large enough for windows to pay.

    Args:
        size: `(width, height)` of the picture.
        canvas: `(width, height)` of the detector's input.

    Returns:
        True where there are two octaves or more to zoom in: the longer side of the picture is at least four times
        that of the detector's input.

    >>> pays((3840, 2160), (416, 416)), pays((640, 480), (416, 416))
    (True, False)
    """
    return Lattice.over(size, canvas).levels >= 3


def search_windows(
    glances: Glances,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    target: int,
    *,
    passes: int = 24,
    confirm: float | None = None,
    give_up: float | None = None,
    closer: int = MOST_CLOSER,
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
    facts: SearchFacts | None = None
    ended, presence = 0, None
    for turn in look_for(glances, evidence, target, confirm=float("inf")):
        glance, ahead = turn.glance, turn.ahead
        facts = facts or SearchFacts(turn.belief)
        facts.add(glance)
        seen.append(glance)
        values.append(turn.worth)
        presence = None
        if facts.detected or ahead < thresholds.give_up:  # otherwise no probability ends the search
            presence = facts.presence(ahead)
            if verifier is None:
                state = torch.tensor([presence]), torch.tensor([facts.detected]), torch.tensor([ahead])
                ended = int(settle(*state, thresholds))
            else:
                room, look = passes - len(seen), WindowLook(glance.detections, len(seen), presence, facts.best, ahead)
                verifier.see(look, last=ahead == 0 or room <= 1)
                values += [place.probability for place in verifier.look_closely(room)]
                ended = verifier.outcome()
        if ended or len(seen) == passes:
            break
    assert facts is not None
    if verifier is not None and verifier.looks:
        decision = verifier.decision(over=ended > 0)
    else:
        presence = facts.presence(ahead) if presence is None else presence
        decision = Decision(OUTCOMES[ended], presence, None, facts.box if OUTCOMES[ended] == "found" else None)
    decided = ended > 0 or decision.outcome == "found"
    ending: Ending = "decision" if decided else "passes" if len(seen) == passes else "windows"
    return ZoomPath(
        lattice=glances.lattice,
        classes=classes,
        target=target,
        glances=tuple(seen),
        values=tuple(values),
        candidates=merge(seen, target),
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
    ending: Ending = "worth"
    with torch.inference_mode():
        for turn in find_everything(glances, evidence, target, batch=batch, worth=worth):
            seen.append(turn.glance)
            values.append(turn.worth)
            if len(seen) == passes:
                ending = "passes"
                break
    return ZoomPath(
        lattice=glances.lattice,
        classes=classes,
        target=target,
        glances=tuple(seen),
        values=tuple(values),
        candidates=merge(seen, target),
        ending=ending,
    )
