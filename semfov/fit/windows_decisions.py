"""Fit the decisions of searches in large pictures: the probability of presence, its thresholds, and closer looks."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.verification import Verification
from semfov.data.scene import Annotation, Scenes
from semfov.decision import SAME, settle
from semfov.detection.detections import Detections
from semfov.fit.protocols import choose_classes
from semfov.fit.searches import TargetSearch
from semfov.fit.thresholds import Bounds, choose_thresholds
from semfov.fit.training import descend
from semfov.fit.verification import VerificationInFolds, choose_confirm, examine, fit_to_closer_looks, verify
from semfov.fit.verification_report import verification_report
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.fit.zoom_store import StoredWindowLooks
from semfov.metrics.calibration import BinarySums
from semfov.metrics.episodes import area_under_roc
from semfov.observation.matching import box_iou
from semfov.observation.thresholds import Thresholds
from semfov.runs.progress import track
from semfov.runs.tables import table
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.closer import CandidateBoxes, SearchLook, look_closely
from semfov.zoom.decision import SearchFacts
from semfov.zoom.episode import WindowStep, look_for
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import WindowLook

_JUDGED = (1, 4, 8, 16)  # numbers of looks after which the probability of presence is evaluated

PicturesByKind = Sequence[tuple[Scenes, Sequence[StoredWindowLooks]]]
"""Pictures of several kinds, with the looks at each picture."""


class _PictureSearch(NamedTuple):
    """A search of a picture without decisions.

    Attributes:
        picture: number of the picture.
        annotation: its objects.
        target: class 1..K.
        steps: its looks, each with the facts about the search after it; these change with the next look.
    """

    picture: int
    annotation: Annotation
    target: int
    steps: Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]


@torch.inference_mode()
def _search_pictures(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredWindowLooks], config: FitMosaicsConfig, title: str
) -> Iterator[_PictureSearch]:
    """Search every picture for some present classes and for as many absent ones, without decisions."""
    for index, looks in enumerate(track(opened, title, "picture")):
        annotation = pictures.annotation(index)
        for target in choose_classes(pictures, index, annotation, config.sought, 1.0, config.seed):
            steps = islice(look_for(looks, model, target), config.passes)
            yield _PictureSearch(index, annotation, target, _with_facts(steps))
        looks.save()


def _with_facts(
    steps: Iterable[WindowStep[ZoomBelief]],
) -> Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]:
    """Go through the looks of a search, each with the facts about the search after it."""
    facts: SearchFacts | None = None
    for step in steps:
        facts = facts or SearchFacts(step.belief)
        facts.add(step.look)
        yield step, facts


class _Known(NamedTuple):
    """What is known after a look of a search; the fields are those of `WindowSearches`."""

    best: float
    case: Tensor
    detected: bool
    hit_chance: float


class WindowSearches(NamedTuple):
    """E searches of n looks; one that ends early is padded with its last values, and with 0 for `hit_chance`.

    Attributes:
        best: `(E, n)`, highest score of the target.
        case: `(E, n, 10)`, what the probability of presence is computed from, beside `best`.
        detected: `(E, n)` boolean, whether a detection shows the target.
        hit_chance: `(E, n)`, value of the best look that is left.
        there: `(E,)` boolean, whether the picture holds the target.
    """

    best: Tensor
    case: Tensor
    detected: Tensor
    hit_chance: Tensor
    there: Tensor

    @classmethod
    @torch.inference_mode()
    def of(
        cls,
        model: GlimpseEvidence,
        pictures: Scenes,
        opened: Sequence[StoredWindowLooks],
        config: FitMosaicsConfig,
        title: str,
    ) -> "WindowSearches":
        """Search every picture for some present classes and for as many absent ones, without decisions."""
        rows: list[tuple[Tensor, ...]] = []
        for search in _search_pictures(model, pictures, opened, config, title):
            known = [
                _Known(facts.best, facts.case(step.next_value), facts.detected, step.next_value)
                for step, facts in search.steps
            ]
            known += [known[-1]._replace(hit_chance=0.0)] * (config.passes - len(known))
            rows.append(
                (
                    torch.tensor([after.best for after in known]),
                    torch.stack([after.case for after in known]),
                    torch.tensor([after.detected for after in known]),
                    torch.tensor([after.hit_chance for after in known]),
                    torch.tensor(bool((search.annotation.labels == search.target).any())),
                )
            )
        return cls(*(torch.stack(column) for column in zip(*rows, strict=True)))

    @classmethod
    def join(cls, several: Iterable["WindowSearches"]) -> "WindowSearches":
        """Concatenate searches of the same number of looks."""
        return cls(*(torch.cat(column) for column in zip(*several, strict=True)))


def fit_judge(model: GlimpseEvidence, searches: WindowSearches, steps: int, batch: int = 4096) -> None:
    """Fit the probability that a picture contains the target, by the cross-entropy after all looks of all searches.

    Args:
        model: evidence by magnification, whose `judge` is fitted.
        searches: E searches of n looks.
        steps: number of training steps.
        batch: largest number of looks in a step.
    """
    best = searches.best.flatten()
    case = searches.case.flatten(0, 1)
    # Every look of a search has the answer of its picture.
    there = searches.there[:, None].expand_as(searches.best).flatten().float()

    def loss_of(_: int) -> Tensor:
        rows = torch.randint(len(best), (min(batch, len(best)),))
        return F.binary_cross_entropy_with_logits(model.anywhere(best[rows], case[rows]), there[rows])

    model.judge.requires_grad_(True)
    descend(model.judge.parameters(), loss_of, steps, 1e-2, decay=1.0, title="fitting decisions")
    model.judge.requires_grad_(False)


@torch.no_grad()
def judge_searches(model: GlimpseEvidence, searches: WindowSearches, bounds: Bounds) -> list[str]:
    """Evaluate the probability of presence on held-out searches, and set the model's thresholds by them.

    Args:
        model: evidence by magnification, with a fitted `judge`.
        searches: E searches of n looks, in pictures of held-out photographs.
        bounds: shares of wrong decisions within which thresholds are chosen.

    Returns:
        A table in Markdown, line by line.
    """
    presence = model.anywhere(searches.best, searches.case).sigmoid()
    there = searches.there
    chosen = choose_thresholds(bounds, presence.mT, searches.detected.mT.to(presence), searches.hit_chance.mT, there)
    # The place is known as soon as a detection shows the target; there is no probability to put a threshold on.
    model.thresholds = chosen.changed(place=0.0)
    rows = [["looks", "area under ROC", "NLL", "Brier", "ECE", "ECE of the highest score"]]
    looks = presence.shape[1]
    has_both_kinds = bool(there.any() and not there.all())
    for number in sorted({looks, *(number for number in _JUDGED if number < looks)}):
        after = presence[:, number - 1]
        sums = BinarySums.of(after, there)
        of_score = BinarySums.of(searches.best[:, number - 1], there)
        area = area_under_roc(after, there) if has_both_kinds else float("nan")
        measures = (area, sums.nll, sums.brier, sums.ece, of_score.ece)
        rows.append([str(number), *(f"{measure:.3f}" for measure in measures)])
    return table(rows)


class _MosaicSearch(TargetSearch[SearchLook]):
    """A search of a mosaic, without closer looks.

    Attributes:
        looks: the looks at the picture.
        objects: `(M, 4)`, annotated boxes of the class.
        least: probability from which on a candidate is likely enough for a closer look.
        steps: what is known after each look.
        window_looks: the looks themselves.
        boxes: `(4,)`, box of the highest score after each look; None where no detection shows the target.
    """

    after = (1, 3, 5, 8, 12, 16, 24)

    def __init__(self, search: _PictureSearch, looks: StoredWindowLooks, passes: int, least: float) -> None:
        self.picture = search.picture
        self.target = search.target
        self.objects = search.annotation.boxes[search.annotation.labels == search.target]
        self.present = len(self.objects) > 0
        self.passes = passes
        self.looks = looks
        self.least = least
        self.steps: list[SearchLook] = []
        self.window_looks: list[WindowLook] = []
        self.boxes: list[Tensor | None] = []
        for number, (step, facts) in enumerate(search.steps, 1):
            presence = facts.presence(step.next_value)
            self.steps.append(SearchLook(step.look.detections, number, presence, facts.best, step.next_value))
            self.window_looks.append(step.look)
            self.boxes.append(facts.box if facts.detected else None)

    def __len__(self) -> int:
        return len(self.steps)

    def look(self, index: int, number: int) -> SearchLook:
        return self.steps[index]._replace(next_index=number)

    def candidates(self) -> CandidateBoxes:
        return CandidateBoxes(self.target, self.least)

    def close_up(self, box: Tensor) -> Detections:
        return look_closely(self.looks, box).detections

    def right(self, box: Tensor) -> bool:
        """Tell whether a box `(4,)` is that of an annotated object of the class."""
        return self.present and float(box_iou(box[None], self.objects).max()) >= SAME

    def outcome(self, index: int, thresholds: Thresholds) -> int:
        after = self.steps[index]
        detected = self.boxes[index] is not None
        presence, known, hit_chance = (torch.tensor([value]) for value in (after.presence, detected, after.hit_chance))
        return int(settle(presence, known, hit_chance, thresholds))

    def found_right(self, index: int) -> bool:
        """Tell whether the box with the highest score is that of an object."""
        box = self.boxes[index]
        assert box is not None
        return self.right(box)


@torch.inference_mode()
def _mosaic_searches(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredWindowLooks], config: FitMosaicsConfig, title: str
) -> Iterator[_MosaicSearch]:
    """Search every picture, without closer looks."""
    assert model.thresholds is not None
    for search in _search_pictures(model, pictures, opened, config, title):
        yield _MosaicSearch(search, opened[search.picture], config.passes, model.thresholds.confirm)


def fit_closer_looks(
    model: GlimpseEvidence,
    pictures: Mapping[str, PicturesByKind],
    config: FitMosaicsConfig,
    prior: Verification | None = None,
) -> str:
    """Fit the verification on some pictures, choose its threshold on held-out ones, and add it to the model.

    Args:
        model: evidence by magnification, with thresholds.
        pictures: those to fit on (`searched`), and those of held-out photographs (`judged`).
        config: settings of searches, and bounds of the threshold.
        prior: centre of the prior of the parameters (None: a weak one around 0).

    Returns:
        The report in Markdown. Without places of both kinds, the model has no verification.
    """
    searched = _all_searches(model, pictures["searched"], config, "looking closely")
    judged = _all_searches(model, pictures["judged"], config, "looking closely at held-out pictures")
    training = examine(searched)
    held_out = examine(judged)
    _save_looks(pictures)
    # From here on the model decides as without closer looks, until it has the new verification.
    model.verification = None
    if training is None or held_out is None:
        return "None, since there are no places that hold the target, or none that do not.\n"
    assert model.thresholds is not None
    stop_below = model.thresholds.stop_below
    fitted = fit_to_closer_looks(training, training.fold == 0, prior)
    decisions = list(verify(judged, [fitted], Thresholds(1.0, stop_below, config.place), model.thresholds))
    confirm = choose_confirm(decisions, config.false_alarms, config.surest)
    fitted.thresholds = Thresholds(confirm, stop_below, config.place)
    model.verification = fitted
    _save_looks(pictures)
    report = verification_report(
        VerificationInFolds(fitted, [fitted], held_out, decisions),
        f"{sum(len(opened) for _, opened in pictures['judged'])} pictures of held-out photographs",
        f"The model was fitted to {len(training.fold)} closer looks at pictures of other photographs.",
    )
    return report.text


def _all_searches(
    model: GlimpseEvidence, pictures: PicturesByKind, config: FitMosaicsConfig, title: str
) -> list[_MosaicSearch]:
    searches: list[_MosaicSearch] = []
    for scenes, opened in pictures:
        searches += _mosaic_searches(model, scenes, opened, config, title)
    return searches


def _save_looks(pictures: Mapping[str, PicturesByKind]) -> None:
    """Store new looks at all pictures."""
    for of_use in pictures.values():
        for _, opened in of_use:
            for looks in opened:
                looks.save()
