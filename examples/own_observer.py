"""Your own observer: remember the largest score of every class in every cell.

It needs no prior and no fusion rule. One confident look outweighs any number of doubtful ones.

Run it from a checkout: python -m examples.own_observer
"""

from dataclasses import dataclass

import torch
from torch import Tensor

import semfov
from semfov.episode import LiveLooks
from semfov.gaze.choice import Greedy, drawn_by
from semfov.sensor import named_sensor


@dataclass(frozen=True)
class ScoreEvidence(semfov.observers.Evidence):
    """Evidence of looks: the largest score of each class in each cell."""

    scores: Tensor  # (B, X·Y, K+1)
    distance: Tensor  # (B, X·Y), from the fixation


@dataclass(frozen=True)
class ScoreBelief(semfov.Belief):
    """The belief: the largest score of each class in each cell so far."""

    scores: Tensor  # (B, X·Y, K+1)
    closest: Tensor  # (B, X·Y), distance to the closest fixation; every belief has it

    def probability(self, target: int | Tensor) -> Tensor:
        """Return the largest score of the target in each cell, `(B, X·Y)`."""
        return self.scores[torch.arange(len(self.scores)), :, target]


class BestScore(semfov.observers.Observer):
    """Keeps the largest score of each class in each cell."""

    def __init__(self, components: int) -> None:
        super().__init__()
        self.components = components

    def start(self, batch: int, grid: semfov.Grid, like: Tensor) -> ScoreBelief:
        """Return the belief before the first look: all scores are 0."""
        scores = like.new_zeros(batch, len(grid), self.components)
        return ScoreBelief(scores, torch.full_like(scores[..., 0], torch.inf))

    def weigh(
        self, detections: semfov.Detections, fixation: Tensor, grid: semfov.Grid, target: int | None = None
    ) -> ScoreEvidence:
        """Compute the largest score among the boxes that overlap a cell."""
        covered = grid.footprint(detections.boxes) & detections.mask[..., None]  # (B, L, X·Y)
        scores = detections.scores.new_zeros(len(fixation), len(grid), self.components)
        for box in range(covered.shape[1]):
            scores = torch.maximum(scores, covered[:, box, :, None] * detections.scores[:, box, None])
        return ScoreEvidence(scores, grid.distance(fixation))

    def update(self, belief: semfov.Belief, look: semfov.observers.Evidence) -> ScoreBelief:
        """Return the belief after one more look."""
        assert isinstance(belief, ScoreBelief)
        assert isinstance(look, ScoreEvidence)
        return ScoreBelief(torch.maximum(belief.scores, look.scores), torch.minimum(belief.closest, look.distance))


def main() -> None:
    """Search an embedded photograph for a dog."""
    detector = semfov.load_detector("yolox-nano")
    eye = semfov.Eye(named_sensor("published"), detector).eval().requires_grad_(False)
    scene = semfov.EmbeddedScenes(detector.classes)[0]
    image = scene.image[None]
    grid = semfov.Grid(10, 10, scene.size)
    dog = detector.classes.index("dog") + 1
    goal = grid.footprint(scene.boxes[scene.labels == dog]).any(0)

    steps = semfov.rollout(
        LiveLooks(eye, eye.open(image), grid),
        BestScore(len(detector.classes) + 1),
        semfov.acquisition.TargetPosterior(dog),
        torch.tensor([0]),  # first cell of each episode; here there is one episode
        Greedy(drawn_by(torch.Generator().manual_seed(0), len(grid), image)),
        most=20,
        ends=lambda step: goal[step.cell],
    )
    for step in steps:
        x, y = step.fixation[0].tolist()
        best = float(step.belief.probability(dog).max())
        print(f"fixation {step.shift + 1} at ({x:.0f}, {y:.0f}), best score of a dog so far {best:.2f}")
    print("found" if goal[step.cell] else "not found")


if __name__ == "__main__":
    main()
