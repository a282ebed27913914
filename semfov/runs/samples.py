"""Labelled detections: the detector's scores, the distance from the fixation, and the true class."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.scene import Annotation
from semfov.detection.detections import Detections
from semfov.observation.matching import match


@dataclass(frozen=True)
class Samples:
    """M detections with their true classes, and the R looks that they come from."""

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
        """All looks at one scene, R of them: their detections, a batch of R, and their fixations `(R, 2)`."""
        numbers = (self.scenes == index).nonzero()[:, 0]
        firsts = torch.searchsorted(self.look, numbers).tolist()
        ends = torch.searchsorted(self.look, numbers + 1).tolist()
        looks = []
        for first, end in zip(firsts, ends, strict=True):
            boxes, scores = self.boxes[None, first:end], self.scores[None, first:end]
            looks.append(Detections(boxes, scores, torch.ones(1, end - first, dtype=torch.bool)))
        return Detections.stack(looks), self.fixations[numbers]

    @classmethod
    @torch.inference_mode()
    def of(cls, detections: Detections, fixations: Tensor, annotation: Annotation, index: int, iou: float) -> "Samples":
        """Label the detections of the looks at one scene; fixations `(R, 2)`."""
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
        joined = {name: torch.cat([getattr(some, name) for some in sets]) for name in _NAMES}
        counts = torch.tensor([len(some.scenes) for some in sets])
        first = (counts.cumsum(0) - counts).repeat_interleave(torch.tensor([len(some) for some in sets]))
        return cls(**{**joined, "look": joined["look"] + first})


_DETECTIONS = ("boxes", "scores", "distance", "labels", "look")
_NAMES = (*_DETECTIONS, "scenes", "fixations")


def all_cells(
    size: tuple[int, int], fixation: Tensor, cells: tuple[int, int] = (10, 10)
) -> tuple[Grid, Tensor, Tensor]:
    """A grid over a whole photograph: every look shows all cells, at their distances from the fixation."""
    grid = Grid(*cells, size)
    return grid, grid.distance(fixation), torch.ones(len(grid), dtype=torch.bool)
