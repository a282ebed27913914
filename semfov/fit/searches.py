"""Searches that a verification is fitted to; all searches of a photograph share its looks, each made only once."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property, partial
from typing import Any, ClassVar, Generic

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.data.scene import Scenes
from semfov.decision import MOST_CLOSER, OUTCOMES, CandidateCells, CandidatePlaces, cell_of, conclude, decide
from semfov.decision.candidates import LookAt, LookType
from semfov.detection.detections import Detections
from semfov.episode import Step, rollout
from semfov.eye import Eye
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_by
from semfov.runs.config import ProtocolConfig
from semfov.runs.looking import CellLooks
from semfov.runs.looks import photograph_looks
from semfov.runs.progress import track
from semfov.runs.protocols import DrawnSearch, choose_classes, choose_searches
from semfov.runs.store import DetectionStore, RememberedLooks


class TargetSearch(ABC, Generic[LookType]):
    """Base of the searches for a class in a picture, with all `steps`: decisions do not move the gaze."""

    after: ClassVar[tuple[int, ...]]
    most: ClassVar[int] = MOST_CLOSER
    picture: int
    target: int
    present: bool
    spare: bool = False
    passes: float = math.inf
    steps: Any
    candidates: Callable[[], CandidatePlaces[LookType]]
    close_up: LookAt

    def look(self, index: int, number: int) -> LookType:
        """Return the look of this index; `number` looks of both kinds were made up to it."""
        return self.steps[index]

    @abstractmethod
    def right(self, box: Tensor) -> bool:
        """Whether the target is at a box `(4,)`."""

    def decided(self, index: int, thresholds: Thresholds) -> tuple[int, bool | None]:
        """The outcome after a look without closer looks, 0 to go on, and whether the target is at the place found."""
        return 0, None


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
        self.eye, self.scenes, self.index, self.number = eye, scenes, index, number
        self.grid, self.targets = grid, targets
        self.looks: RememberedLooks[int | tuple[float, ...], Detections] = RememberedLooks(
            lambda: photograph_looks(eye, lambda: scenes[index].image[None], grid), store, lambda: scenes.digest(index)
        )


def open_photographs(
    eye: Eye, scenes: Scenes, chosen: Sequence[int], config: Any, *, store: DetectionStore | None = None, spare: int = 0
) -> list[SearchedPhotograph]:
    """Draw classes to search for in photographs, by a `VerificationConfig`."""
    photographs, seed, area = list[SearchedPhotograph](), config.seed, config.max_target_area
    protocol = ProtocolConfig(seed=seed)
    for index in chosen:
        annotation = scenes.annotation(index)
        grid = Grid(config.columns, config.rows, annotation.size)
        targets = choose_classes(scenes, index, annotation, config.classes, area, seed, config.absent)
        held = set(annotation.labels.tolist())
        more = sum(target not in held for target in targets) + spare
        # The same draw with a larger number begins with the same classes.
        wide = choose_searches(scenes, index, grid, protocol, config.classes, area, more)
        drawn = tuple(search._replace(spare=number >= len(targets)) for number, search in enumerate(wide))
        if targets:
            photographs.append(SearchedPhotograph(eye, scenes, index, len(photographs), grid, drawn, store))
    return photographs


class _PhotographSearch(TargetSearch[Step]):
    """A search of a photograph, where the class is most probable."""

    after = (1, 3, 5, 8, 12)

    def __init__(
        self, photograph: SearchedPhotograph, target: DrawnSearch, evidence: TargetEvidence, looks: int
    ) -> None:
        self.picture, self.target = photograph.number, target.target
        self.present, self.spare = target.present, target.spare
        self.candidates = partial(CandidateCells, photograph.grid, target.target)
        self.close_up = lambda box: photograph.looks(tuple(box.tolist()))
        self.photograph, self.sought, self.evidence, self.most_looks = photograph, target, evidence, looks

    @cached_property
    def steps(self) -> list[Step]:
        """Looks where the class is most probable, at most as many as given."""
        photograph, sought = self.photograph, self.sought
        source = CellLooks(photograph.looks, photograph.grid, photograph.grid.centres, sought.target)
        choice = Greedy(drawn_by(torch.Generator().manual_seed(0), len(photograph.grid), source.like))
        observer, policy = Target(self.evidence), TargetPosterior(sought.target)
        return list(rollout(source, observer, policy, sought.start, choice, most=self.most_looks))

    def right(self, box: Tensor) -> bool:
        """Whether an object of the class overlaps the cell of a box `(4,)`."""
        return bool(self.sought.goal[cell_of(box, self.photograph.grid)])

    def decided(self, index: int, thresholds: Thresholds) -> tuple[int, bool | None]:
        """The outcome by the belief alone; the place is right if an object overlaps the cell of strongest evidence."""
        outcome = int(decide(self.steps[index], self.target, thresholds))
        if OUTCOMES[outcome] != "found":
            return outcome, None
        looks = [step.detections for step in self.steps[: index + 1]]
        decision = conclude(1, self.steps[index].belief, looks, self.photograph.grid, self.target)
        return outcome, bool(self.sought.goal[decision.cell])


def photograph_searches(
    photographs: Sequence[SearchedPhotograph], evidence: TargetEvidence, looks: int, title: str
) -> Iterator[_PhotographSearch]:
    """Search photographs for all their classes; after the searches of one, its looks are stored and freed."""
    for photograph in track(photographs, title, "photograph"):
        for target in photograph.targets:
            yield _PhotographSearch(photograph, target, evidence, looks)
        photograph.looks.close()
