"""Searches that a verification is fitted to; all searches of a photograph share its looks, each made only once."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import SemanticSearch
from semfov.decision import (
    FOUND,
    CandidateCells,
    cell_of,
    decide,
    decision_without_closer_looks,
)
from semfov.detection.detections import Detections
from semfov.episode import Step, rollout
from semfov.fit.settings import VerificationConfig
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_by
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.config import ProtocolConfig
from semfov.runs.looking import CellLooks, Looking
from semfov.runs.progress import track
from semfov.runs.protocols import DrawnSearch, choose_classes, choose_searches
from semfov.runs.store import RememberedLooks


class SearchEnd(NamedTuple):
    """End of a search.

    Attributes:
        right: whether the target is at the place that the search found; None if it found none.
        looks: number of looks until then, with closer looks.
    """

    right: bool | None
    looks: int


@dataclass(frozen=True)
class SearchedPhotograph:
    """A photograph with the classes to search for, and all looks at it so far.

    Attributes:
        index: number of the photograph in its set.
        number: number among those that are searched.
        grid: the cells.
        targets: the searches.
        looks: looks by cell and by box.
    """

    index: int
    number: int
    grid: Grid
    targets: tuple[DrawnSearch, ...]
    looks: RememberedLooks[int | tuple[float, ...], Detections]


def open_photographs(
    run: Looking, chosen: Sequence[int], config: VerificationConfig, *, spare: int = 0
) -> list[SearchedPhotograph]:
    """Draw classes to search for in photographs.

    Args:
        run: the photographs and their stored looks.
        chosen: numbers of those to search.
        config: how classes are drawn.
        spare: number of further absent classes in each photograph, which serve only to choose thresholds.

    Returns:
        The photographs that hold or lack a class to search for.
    """
    photographs: list[SearchedPhotograph] = []
    protocol = ProtocolConfig(seed=config.seed)
    scenes = run.scenes
    for index in chosen:
        annotation = scenes.annotation(index)
        grid = run.grid(index)
        targets = choose_classes(
            scenes, index, annotation, config.classes, config.max_target_area, config.seed, config.absent
        )
        if not targets:
            continue
        held = set(annotation.labels.tolist())
        absent = sum(target not in held for target in targets) + spare
        # The same draw with a larger number begins with the same classes.
        searches = choose_searches(scenes, index, grid, protocol, config.classes, config.max_target_area, absent)
        drawn = tuple(search._replace(spare=place >= len(targets)) for place, search in enumerate(searches))
        photographs.append(SearchedPhotograph(index, len(photographs), grid, drawn, run.looks(index)))
    return photographs


class TargetSearch:
    """A search of a photograph, with all its looks where the class is most probable: decisions do not move the gaze.

    It assumes how often the class is searched for.

    Attributes:
        after: numbers of looks after which places are examined for the fit.
        picture: number of the photograph among those of the fit.
        target: the class, 1..K.
        present: whether the photograph holds the class.
        spare: whether the search serves only to choose thresholds.
    """

    after = (1, 3, 5, 8, 12)

    def __init__(
        self, photograph: SearchedPhotograph, search: DrawnSearch, model: FovealObservationModel, looks: int
    ) -> None:
        self.picture = photograph.number
        self.target = search.target
        self.present = search.present
        self.spare = search.spare
        self.photograph = photograph
        self.search = search
        self.observer = SemanticSearch(model).with_prior("fit", search.target)
        self.thresholds = None if model.presence is None else model.presence.thresholds
        self.most_looks = looks

    @cached_property
    def steps(self) -> list[Step]:
        """Looks where the class is most probable, at most `most_looks`."""
        photograph = self.photograph
        grid = photograph.grid
        source = CellLooks(photograph.looks, grid, grid.centres, self.target)
        # The same ties each time: a fit makes its searches twice (`fit_in_folds`).
        choice = Greedy(drawn_by(torch.Generator().manual_seed(0), len(grid), source.like))
        policy = TargetPosterior(self.target)
        return list(rollout(source, self.observer, policy, self.search.start, choice, most=self.most_looks))

    def candidates(self) -> CandidateCells:
        """Make the places that seem to hold the target, before any look."""
        return CandidateCells(self.photograph.grid, self.target, prior=self.observer.prior)

    def close_up(self, box: Tensor) -> Detections:
        """Look closely at a box `(4,)`."""
        return self.photograph.looks(tuple(box.tolist()))

    def right(self, box: Tensor) -> bool:
        """Tell whether an object of the class overlaps the cell of a box `(4,)`."""
        return bool(self.search.goal[cell_of(box, self.photograph.grid)])

    def unverified(self) -> SearchEnd | None:
        """Decide without closer looks, by the thresholds of the model; None without these.

        The place is right if an object overlaps the cell of the decision.
        """
        if self.thresholds is None:
            return None
        for index, step in enumerate(self.steps):
            outcome = int(decide(step, self.target, self.thresholds))
            if outcome == FOUND:
                looks = [earlier.detections for earlier in self.steps[: index + 1]]
                decision = decision_without_closer_looks(outcome, step.belief, looks, self.photograph.grid, self.target)
                return SearchEnd(bool(self.search.goal[decision.cell]), index + 1)
            if outcome:
                return SearchEnd(None, index + 1)
        return SearchEnd(None, len(self.steps))


def photograph_searches(
    photographs: Sequence[SearchedPhotograph], model: FovealObservationModel, looks: int, title: str
) -> Iterator[TargetSearch]:
    """Search photographs for all their classes; after the searches of one, its looks are stored and freed.

    Args:
        photographs: photographs with the classes to search for.
        model: tells from the looks where the class may be.
        looks: largest number of looks in a search.
        title: title of the progress bar.

    Yields:
        The searches, photograph by photograph.
    """
    for photograph in track(photographs, title, "photograph"):
        for search in photograph.targets:
            yield TargetSearch(photograph, search, model, looks)
        photograph.looks.close()
