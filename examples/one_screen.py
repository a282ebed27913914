"""The paper's search on one screen: picture, look, detections, observation, belief, choice, decision, record.

The steps are those of `ActivePerception.published(search="non-predictive").search(…)`, written out for one picture, one
target and one episode, with the same numbers. The library does the same for many episodes at once, on any device.

Run it from a checkout: python -m examples.one_screen
"""

from dataclasses import dataclass

import torch
from torch import Tensor

import semfov
from semfov.gaze import select_fixation

COLUMNS, ROWS = 10, 10  # cells of the map
SHIFTS = 30  # gaze shifts at most
PRIOR = 0.5  # Dirichlet parameter of every class in every cell before the first look
CONFIRM = 0.5  # least score of a detection of the target that is found


@dataclass(frozen=True)
class Look:
    """One look: the fixated cell, what the detector showed, and the map afterwards, `(X·Y, K+1)`."""

    cell: int
    fixation: Tensor
    detections: semfov.Detections
    beta: Tensor


@dataclass(frozen=True)
class Found:
    """The record of a search: all looks, and the last one's detection of the target, if it was found."""

    looks: list[Look]
    box: Tensor | None
    probability: float


class Searcher:
    """A fovea, a detector and an observation model, which search a picture for a class."""

    def __init__(self, detector: str = "yolox-nano") -> None:
        self.fovea = semfov.Foveation(sigma=100.0, growth=1.0)  # in pixels of an image whose longer side is 640
        self.detector = semfov.load_detector(detector)
        self.model = semfov.FovealObservationModel.from_pretrained(f"{detector}-published")

    def search(self, image: Tensor, target: int, start: int, seed: int = 0) -> Found:
        """Search a picture `(3, H, W)` for a class 1..K, from a cell on."""
        height, width = image.shape[-2:]
        grid = semfov.Grid(COLUMNS, ROWS, (width, height))
        ties = torch.Generator().manual_seed(seed)

        # The eye sees the picture at the detector's resolution, and the fovea is scaled with it.
        canvas, placement = self.detector.fit(image[None])
        scale = torch.tensor(placement.scale) * (max(width, height) / 640)
        pyramid = self.fovea.open(canvas, scale)

        beta = torch.full((len(grid), len(self.detector.classes) + 1), PRIOR)
        visited = torch.zeros(len(grid), dtype=torch.bool)
        looks: list[Look] = []
        cell = start
        while len(looks) <= SHIFTS:
            # Look: foveate around the centre of the cell, and detect objects in the view.
            fixation = grid.centres[cell]
            view = self.fovea.look(pyramid, placement.points_to_canvas(fixation[None]))
            detections = self.detector.detect(view, placement)
            visited[cell] = True

            # Observation and belief: calibrate the scores of each detection by its distance from the fovea (equation
            # 11), and update the cells that its box overlaps by Kaplan's rule (equation 7).
            distances = grid.box_distance(detections.boxes[0], fixation)
            likelihoods = self.model.calibrate(detections.scores[0], distances)
            footprints = grid.footprint(detections.boxes[0])
            for likelihood, covered in zip(likelihoods, footprints, strict=True):
                if covered.any():
                    beta[covered] = semfov.fusion.kaplan(beta[covered], likelihood)
            looks.append(Look(cell, fixation, detections, beta.clone()))
            probability = beta[:, target] / beta.sum(-1)

            # Decision: found, if a detection that overlaps the fixated cell shows the target with a sufficient score.
            shown = detections.scores[0, :, target] >= CONFIRM
            if bool((footprints[:, cell] & shown).any()):
                return Found(looks, strongest_box(looks, grid, target), float(probability.max()))

            # Choice: the cell where the target is most probable (equation 12) among those not visited.
            noise = torch.rand(1, len(grid), generator=ties)
            cell = int(select_fixation(probability[None], visited[None], noise))
            if cell < 0:
                break
        return Found(looks, None, float(probability.max()))


def strongest_box(looks: list[Look], grid: semfov.Grid, target: int) -> Tensor:
    """Find the box of the target in the last cell: of all looks the one with the highest score, weighted by place."""
    boxes = torch.cat([look.detections.boxes[0] for look in looks])
    scores = torch.cat([look.detections.scores[0, :, target] for look in looks])
    weights = grid.footprint(boxes, "soft")[:, looks[-1].cell]
    return boxes[(scores * weights).argmax()]


@torch.inference_mode()
def main() -> None:
    """Search a photograph that comes with semfov for a class that it shows."""
    image = semfov.example("beach")
    searcher = Searcher()
    target = 1 + searcher.detector.classes.index("boat")
    record = searcher.search(image, target, start=0)
    for number, look in enumerate(record.looks):
        x, y = look.fixation.tolist()
        print(f"look {number} at ({x:.0f}, {y:.0f}): {look.detections.mask.sum()} detections")
    outcome = "not found" if record.box is None else f"found at {[round(side) for side in record.box.tolist()]}"
    print(f"boat {outcome} after {len(record.looks)} looks (probability {record.probability:.2f})")


if __name__ == "__main__":
    main()
