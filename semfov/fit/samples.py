"""Looks at photographs with their annotations: labelled detections, and the classes of cells."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation, Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.metrics.episodes import answers_of
from semfov.observation.matching import match


@dataclass(frozen=True)
class Samples:
    """M detections with their true classes, and the R looks that they come from.

    Attributes:
        boxes: `(M, 4)`.
        scores: `(M, K+1)`.
        distance: `(M,)`, from the fixation, in units of the image's longer side (for windows, octaves of reduction).
        labels: `(M,)`, true class 1..K, or 0 for background.
        look: `(M,)`, number of the look; ascending.
        scenes: `(R,)`, number of the scene of each look.
        fixations: `(R, 2)`, in pixels.
    """

    boxes: Tensor
    scores: Tensor
    distance: Tensor
    labels: Tensor
    look: Tensor
    scenes: Tensor
    fixations: Tensor

    def __len__(self) -> int:
        return len(self.labels)

    def __getitem__(self, index: Tensor) -> "Samples":
        """Select detections; all looks are kept."""
        chosen = {name: getattr(self, name)[index] for name in _DETECTIONS}
        return Samples(**chosen, scenes=self.scenes, fixations=self.fixations)

    @property
    def scene(self) -> Tensor:
        """Index of the scene of each detection, `(M,)`."""
        return self.scenes[self.look]

    def looks_at(self, index: int) -> tuple[Detections, Tensor]:
        """Return the looks at one scene.

        Args:
            index: number of the scene.

        Returns:
            Their detections, a batch of n, and their fixations `(n, 2)`.
        """
        numbers = (self.scenes == index).nonzero()[:, 0]
        # Detections are in the order of their looks.
        firsts = torch.searchsorted(self.look, numbers).tolist()
        ends = torch.searchsorted(self.look, numbers + 1).tolist()
        looks = []
        for first, end in zip(firsts, ends, strict=True):
            mask = torch.ones(1, end - first, dtype=torch.bool)
            looks.append(Detections(self.boxes[None, first:end], self.scores[None, first:end], mask))
        return Detections.stack(looks), self.fixations[numbers]

    @classmethod
    @torch.inference_mode()
    def of(cls, detections: Detections, fixations: Tensor, annotation: Annotation, index: int, iou: float) -> "Samples":
        """Label the detections of the looks at one scene.

        Args:
            detections: a batch of R looks.
            fixations: `(R, 2)`, in pixels.
            annotation: the objects of the scene.
            index: number of the scene.
            iou: least overlap at which a detection counts as showing an object.

        Returns:
            The labelled detections.
        """
        labels = [
            match(boxes[mask], annotation.boxes, annotation.labels, iou=iou)
            for boxes, mask in zip(detections.boxes, detections.mask, strict=True)
        ]
        return cls(
            boxes=detections.boxes[detections.mask],
            scores=detections.scores[detections.mask],
            distance=Grid(1, 1, annotation.size).box_distance(detections.boxes, fixations)[detections.mask],
            labels=torch.cat(labels),
            look=detections.mask.nonzero()[:, 0],
            scenes=torch.full((len(fixations),), index),
            fixations=fixations,
        )

    @classmethod
    def join(cls, sets: "list[Samples]") -> "Samples":
        """Concatenate several sets of samples in order."""
        joined = {}
        for name in _NAMES:
            joined[name] = torch.cat([getattr(samples, name) for samples in sets])
        # Looks are numbered through all sets.
        looks = torch.tensor([len(samples.scenes) for samples in sets])
        detections = torch.tensor([len(samples) for samples in sets])
        looks_before = (looks.cumsum(0) - looks).repeat_interleave(detections)
        return cls(**{**joined, "look": joined["look"] + looks_before})


_DETECTIONS = ("boxes", "scores", "distance", "labels", "look")
_NAMES = (*_DETECTIONS, "scenes", "fixations")


def all_cells(
    size: tuple[int, int], fixation: Tensor, cells: tuple[int, int] = (10, 10)
) -> tuple[Grid, Tensor, Tensor]:
    """Lay a grid over a whole photograph: every look shows all cells.

    Args:
        size: `(width, height)` of the photograph.
        fixation: `(2,)`, in pixels.
        cells: columns and rows.

    Returns:
        The grid, the distance of each cell from the fixation `(X·Y,)`, and which cells the look shows `(X·Y,)`: all.
    """
    grid = Grid(*cells, size)
    return grid, grid.distance(fixation), torch.ones(len(grid), dtype=torch.bool)


@dataclass(frozen=True)
class AnnotatedLooks:
    """Looks at a photograph, and the true classes of its cells.

    Attributes:
        photograph: its number.
        detections: of R looks.
        fixations: `(R, 2)`, in pixels.
        grid: the cells.
        answers: `(X·Y, K+1)` boolean, the classes of a cell, or background alone.
        targets: `(T,)`, classes 1..K that may be searched for.
    """

    photograph: int
    detections: Detections
    fixations: Tensor
    grid: Grid
    answers: Tensor
    targets: Tensor

    @property
    def goal(self) -> Tensor:
        """Cells that hold each target, `(T, X·Y)` boolean."""
        return self.answers[:, self.targets].T.contiguous()


def annotated_looks(
    scenes: Scenes,
    looks: Iterable[tuple[int, Detections, Tensor]],
    cells: tuple[int, int],
    max_target_area: float | None = None,
) -> Iterator[AnnotatedLooks]:
    """Find the true classes of the cells of photographs.

    Args:
        scenes: the photographs.
        looks: number of a photograph, detections of R looks at it, and their fixations `(R, 2)`, in pixels.
        cells: columns and rows of the grid.
        max_target_area: classes that cover a larger share of the image are not searched for; None: no limit.

    Yields:
        The looks at each photograph with objects.
    """
    for index, detections, fixations in looks:
        annotation = scenes.annotation(index)
        grid = Grid(*cells, annotation.size)
        answers = answers_of(annotation, grid, len(scenes.classes) + 1)
        if not answers.any():
            continue
        # A target in every cell is found at once.
        is_search = answers.any(0) & ~answers.all(0)
        legal = legal_targets(annotation, max_target_area)
        targets = torch.tensor([target for target in legal if is_search[target]], dtype=torch.long)
        # Last: the background is no target, and with it no photograph would be without an answer.
        answers[:, 0] = ~answers.any(-1)
        yield AnnotatedLooks(index, detections, fixations, grid, answers, targets)
