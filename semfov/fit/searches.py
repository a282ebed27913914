"""Searches that a verification is fitted to; all searches of a photograph share its looks, each made only once."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import ClassVar, Generic, NamedTuple, Protocol

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import SemanticSearch
from semfov.data.scene import Scenes
from semfov.decision import MOST_CLOSER, OUTCOMES, CandidateCells, CandidatePlaces, cell_of, conclude, decide
from semfov.decision.candidates import LookType
from semfov.detection.detections import Detections
from semfov.episode import Step, rollout
from semfov.eye import Eye
from semfov.fit.looking import CellLooks
from semfov.fit.protocols import DrawnSearch, choose_classes, choose_searches
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_by
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.thresholds import Thresholds
from semfov.runs.config import ProtocolConfig
from semfov.runs.looks import photograph_looks
from semfov.runs.progress import track
from semfov.runs.store import DetectionStore, RememberedLooks


class SearchEnd(NamedTuple):
    """End of a search.

    Attributes:
        right: whether the target is at the place that the search found; None if it found none.
        looks: number of looks until then, with closer looks.
    """

    right: bool | None
    looks: int


class TargetSearch(ABC, Generic[LookType]):
    """Base of the searches for a class in a picture, with all their looks: decisions do not move the gaze.

    Attributes:
        after: numbers of looks after which places are examined for the fit.
        most: largest number of closer looks.
        picture: number of the picture among those of the fit.
        target: the class, 1..K.
        present: whether the picture holds the class.
        spare: whether the search serves only to choose thresholds.
        passes: largest number of looks, with closer looks.
    """

    after: ClassVar[tuple[int, ...]]
    most: ClassVar[int] = MOST_CLOSER
    picture: int
    target: int
    present: bool
    spare: bool = False
    passes: float = math.inf

    @abstractmethod
    def __len__(self) -> int:
        """Count the looks, without closer looks."""

    @abstractmethod
    def look(self, index: int, number: int) -> LookType:
        """Return the look of this index; `number` looks of both kinds were made up to it."""

    @abstractmethod
    def candidates(self) -> CandidatePlaces[LookType]:
        """Make the places that seem to hold the target, before any look."""

    @abstractmethod
    def close_up(self, box: Tensor) -> Detections:
        """Look closely at a box `(4,)`."""

    @abstractmethod
    def right(self, box: Tensor) -> bool:
        """Tell whether the target is at a box `(4,)`."""

    def outcome(self, index: int, thresholds: Thresholds) -> int:
        """Decide after a look by the belief alone: the outcome's number in `OUTCOMES`, 0 to go on."""
        return 0

    def found_right(self, index: int) -> bool:
        """Tell whether the target is at the place that a search finds after a look by the belief alone."""
        raise NotImplementedError(f"{type(self).__name__} finds no place without closer looks")

    def unverified_end(self, thresholds: Thresholds | None) -> SearchEnd:
        """Decide along the looks without closer looks; nothing is found without thresholds."""
        if thresholds is not None:
            for index in range(len(self)):
                outcome = self.outcome(index, thresholds)
                if OUTCOMES[outcome] == "found":
                    return SearchEnd(self.found_right(index), index + 1)
                if outcome:
                    return SearchEnd(None, index + 1)
        return SearchEnd(None, len(self))


class SearchedPhotograph:
    """A photograph with the classes to search for, and all looks at it so far, by cell and by box."""

    def __init__(
        self,
        eye: Eye,
        scenes: Scenes,
        index: int,
        number: int,
        grid: Grid,
        targets: tuple[DrawnSearch, ...],
        store: DetectionStore | None = None,
    ) -> None:
        self.eye = eye
        self.scenes = scenes
        self.index = index
        self.number = number
        self.grid = grid
        self.targets = targets
        self.looks: RememberedLooks[int | tuple[float, ...], Detections] = RememberedLooks(
            self._open, store, lambda: scenes.digest(index)
        )

    def _open(self) -> Callable[[int | tuple[float, ...]], Detections]:
        return photograph_looks(self.eye, lambda: self.scenes[self.index].image[None], self.grid)


class DrawingSettings(Protocol):
    """Settings by which classes to search for are drawn, as those of a `VerificationConfig`."""

    @property
    def columns(self) -> int:
        """Columns of the grid."""

    @property
    def rows(self) -> int:
        """Rows of the grid."""

    @property
    def classes(self) -> int:
        """Largest number of present classes in each photograph."""

    @property
    def absent(self) -> int | None:
        """Largest number of absent classes; None: as many as present ones."""

    @property
    def max_target_area(self) -> float:
        """Share of the image from which on a class is too large to be searched for."""

    @property
    def seed(self) -> int:
        """Seed of the draw."""


def open_photographs(
    eye: Eye,
    scenes: Scenes,
    chosen: Sequence[int],
    config: DrawingSettings,
    *,
    store: DetectionStore | None = None,
    spare: int = 0,
) -> list[SearchedPhotograph]:
    """Draw classes to search for in photographs.

    Args:
        eye: looks at the photographs.
        scenes: the photographs.
        chosen: numbers of those to search.
        config: how classes are drawn.
        store: keeps the looks on disk (None: they stay in memory).
        spare: number of further absent classes in each photograph, which serve only to choose thresholds.

    Returns:
        The photographs that hold or lack a class to search for.
    """
    photographs: list[SearchedPhotograph] = []
    protocol = ProtocolConfig(seed=config.seed)
    for index in chosen:
        annotation = scenes.annotation(index)
        grid = Grid(config.columns, config.rows, annotation.size)
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
        photographs.append(SearchedPhotograph(eye, scenes, index, len(photographs), grid, drawn, store))
    return photographs


class _PhotographSearch(TargetSearch[Step]):
    """A search of a photograph, where the class is most probable; it assumes how often the class is searched for."""

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
        self.most_looks = looks

    @cached_property
    def steps(self) -> list[Step]:
        """Looks where the class is most probable, at most `most_looks`."""
        photograph = self.photograph
        grid = photograph.grid
        source = CellLooks(photograph.looks, grid, grid.centres, self.target)
        choice = Greedy(drawn_by(torch.Generator().manual_seed(0), len(grid), source.like))
        policy = TargetPosterior(self.target)
        return list(rollout(source, self.observer, policy, self.search.start, choice, most=self.most_looks))

    def __len__(self) -> int:
        return len(self.steps)

    def look(self, index: int, number: int) -> Step:
        return self.steps[index]

    def candidates(self) -> CandidateCells:
        return CandidateCells(self.photograph.grid, self.target, prior=self.observer.prior)

    def close_up(self, box: Tensor) -> Detections:
        return self.photograph.looks(tuple(box.tolist()))

    def right(self, box: Tensor) -> bool:
        """Tell whether an object of the class overlaps the cell of a box `(4,)`."""
        return bool(self.search.goal[cell_of(box, self.photograph.grid)])

    def outcome(self, index: int, thresholds: Thresholds) -> int:
        return int(decide(self.steps[index], self.target, thresholds))

    def found_right(self, index: int) -> bool:
        """Tell whether an object overlaps the cell of the decision."""
        looks = [step.detections for step in self.steps[: index + 1]]
        found = OUTCOMES.index("found")
        decision = conclude(found, self.steps[index].belief, looks, self.photograph.grid, self.target)
        return bool(self.search.goal[decision.cell])


def photograph_searches(
    photographs: Sequence[SearchedPhotograph], model: FovealObservationModel, looks: int, title: str
) -> Iterator[_PhotographSearch]:
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
            yield _PhotographSearch(photograph, search, model, looks)
        photograph.looks.close()
