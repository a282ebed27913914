"""Fit the decisions of searches in large pictures: the probability of presence, and thresholds."""

from collections.abc import Sequence
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.agents.episode import EpisodeLimits, Goal
from semfov.agents.window_episode import WindowEpisode, WindowTask
from semfov.data.scene import Annotation, Scenes
from semfov.fit.logistic import logistic_regression
from semfov.fit.thresholds import Bounds, choose_thresholds
from semfov.fit.verification import VerifiedSearch, choose_confirm
from semfov.fit.verification_report import places_report
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.metrics.calibration import BinarySums
from semfov.metrics.episodes import area_under_roc
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.observation.thresholds import Thresholds
from semfov.paths import ZoomPath
from semfov.runs.progress import track
from semfov.runs.protocols import choose_classes
from semfov.runs.tables import table
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.zoom.episode import look_for
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import WindowLooks
from semfov.zoom.places import SearchFacts

_JUDGED = (1, 4, 8, 16)  # numbers of looks after which the probability of presence is evaluated


class _Known(NamedTuple):
    """What is known after a look of a search; the fields are those of `WindowSearches`."""

    best: float
    expected: float
    detected: bool
    hit_chance: float


class MosaicSearch:
    """A search of a large picture, without decisions and without closer looks.

    Attributes:
        model: evidence by magnification, which chooses the looks; its `whole` may be fitted to them afterwards.
        source: the looks at the picture.
        picture: number of the picture among those of its kind.
        target: the class, 1..K.
        objects: `(M, 4)`, annotated boxes of the class.
        present: whether the picture holds the class.
        passes: largest number of looks.
        known: what is known after each look.
    """

    def __init__(
        self,
        model: GlimpseEvidence,
        source: StoredWindowLooks,
        picture: int,
        annotation: Annotation,
        target: int,
        passes: int,
    ) -> None:
        self.model = model
        self.source = source
        self.picture = picture
        self.target = target
        self.objects = annotation.boxes[annotation.labels == target]
        self.present = len(self.objects) > 0
        self.passes = passes
        self.known: list[_Known] = []
        facts: SearchFacts | None = None
        for step in islice(look_for(source, model, target), passes):
            facts = facts or SearchFacts(step.belief)
            facts.add(step.look)
            self.known.append(_Known(facts.best, facts.expected(), facts.detected, step.next_value))

    def verified(self) -> VerifiedSearch:
        """Search again as an agent does, with its closer looks; a threshold `confirm` of 1 lets it make all of them."""
        path = search_to_end(self.model, self.source, self.target, self.passes)
        assert path.decision is not None
        closer = [(look, look.index) for look in path.closer if look.index is not None]
        return VerifiedSearch(
            picture=self.picture,
            present=self.present,
            spare=False,
            places=tuple((look.place, self.right(look.box)) for look, _ in closer),
            ends=tuple(index + 1 for _, index in closer),
            presence=path.decision.probability,
            looks=path.passes,
            unverified=None,
        )

    def right(self, box: Tensor) -> bool:
        """Tell whether a box `(4,)` is that of an annotated object of the class."""
        return self.present and float(box_iou(box[None], self.objects).max()) >= SAME_OBJECT_IOU


def search_to_end(model: GlimpseEvidence, source: WindowLooks, target: int, passes: int) -> ZoomPath:
    """Search a picture as an agent does.

    Args:
        model: evidence by magnification, with the thresholds of the search.
        source: the looks at the picture.
        target: the class, 1..K.
        passes: largest number of looks.

    Returns:
        The record.
    """
    names = tuple(map(str, range(model.classes + 1)))
    task = WindowTask(Goal.of(names, target), model)
    return WindowEpisode(task, source, EpisodeLimits(passes)).run()


@torch.inference_mode()
def search_pictures(
    model: GlimpseEvidence,
    pictures: Scenes,
    opened: Sequence[StoredWindowLooks],
    config: FitMosaicsConfig,
    title: str,
) -> list[MosaicSearch]:
    """Search every picture for some present classes and for as many absent ones.

    Args:
        model: evidence by magnification.
        pictures: the pictures.
        opened: the looks at each of them.
        config: numbers of classes and looks, and seed.
        title: title of the progress bar.

    Returns:
        The searches.
    """
    searches: list[MosaicSearch] = []
    for index, looks in enumerate(track(opened, title, "picture")):
        annotation = pictures.annotation(index)
        targets = choose_classes(pictures, index, annotation, config.sought, 1.0, config.seed)
        searches += [MosaicSearch(model, looks, index, annotation, target, config.passes) for target in targets]
        looks.save()
    return searches


class WindowSearches(NamedTuple):
    """E searches of n looks; one that ends early is padded with its last values, and with 0 for `hit_chance`.

    Attributes:
        best: `(E, n)`, highest score of the target.
        expected: `(E, n)`, expected number of its objects.
        detected: `(E, n)` boolean, whether a detection shows the target.
        hit_chance: `(E, n)`, value of the best look that is left.
        there: `(E,)` boolean, whether the picture holds the target.
    """

    best: Tensor
    expected: Tensor
    detected: Tensor
    hit_chance: Tensor
    there: Tensor

    @classmethod
    def of(cls, searches: Sequence[MosaicSearch], looks: int) -> "WindowSearches":
        """Put searches side by side, each padded to the same number of looks."""
        rows: list[tuple[Tensor, ...]] = []
        for search in searches:
            known = [*search.known]
            known += [known[-1]._replace(hit_chance=0.0)] * (looks - len(known))
            rows.append(
                (
                    torch.tensor([after.best for after in known]),
                    torch.tensor([after.expected for after in known]),
                    torch.tensor([after.detected for after in known]),
                    torch.tensor([after.hit_chance for after in known]),
                    torch.tensor(search.present),
                )
            )
        return cls(*(torch.stack(column) for column in zip(*rows, strict=True)))


@torch.no_grad()
def fit_presence(model: GlimpseEvidence, searches: WindowSearches) -> None:
    """Fit the probability that a picture contains the target, by its likelihood after all looks of all searches.

    Args:
        model: evidence by magnification, whose `whole` is fitted.
        searches: E searches of n looks. Those of one kind tell nothing, and leave the model as it is.
    """
    if searches.there.all() or not searches.there.any():
        return
    # Every look of a search has the answer of its picture.
    there = searches.there[:, None].expand_as(searches.best).flatten()
    facts = model.presence_facts(searches.best, searches.expected).flatten(0, 1)
    offset, *weights = logistic_regression(facts, there)
    model.whole.weight.copy_(torch.tensor([weights]))
    model.whole.bias.fill_(offset)


@torch.no_grad()
def judge_searches(model: GlimpseEvidence, searches: WindowSearches, bounds: Bounds) -> list[str]:
    """Evaluate the probability of presence on held-out searches, and set the model's thresholds by them.

    Args:
        model: evidence by magnification, with a fitted `whole`.
        searches: E searches of n looks, in pictures of held-out photographs.
        bounds: shares of wrong decisions within which thresholds are chosen.

    Returns:
        A table in Markdown, line by line.
    """
    presence = model.presence(searches.best, searches.expected).sigmoid()
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


def choose_places(model: GlimpseEvidence, searches: Sequence[MosaicSearch], config: FitMosaicsConfig) -> list[str]:
    """Choose the threshold of places on held-out searches with closer looks, and add it to the model.

    Args:
        model: evidence by magnification, with thresholds.
        searches: searches of pictures of held-out photographs.
        config: bounds of the threshold.

    Returns:
        The report in Markdown, line by line.
    """
    assert model.thresholds is not None
    # With `confirm` 1 all closer looks are made, so that any threshold can be applied to a search afterwards.
    limits = Thresholds(1.0, model.thresholds.stop_below, config.place)
    model.places = limits
    verified = [search.verified() for search in track(searches, "looking closely", "search")]
    model.places = limits.changed(confirm=choose_confirm(verified, config.false_alarms, config.surest))
    pictures = f"{len({id(search.source) for search in searches})} pictures of held-out photographs"
    return places_report(verified, model.places.confirm, pictures)
