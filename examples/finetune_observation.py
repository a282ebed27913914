"""Fine-tune an observation model by backpropagation through the belief, so that search finds targets sooner.

A look at a scene gives detections. The observation model turns their scores into likelihoods, Kaplan's rule fuses them
into the belief, and the next fixation goes to the cell where the target is most probable. All of this is
differentiable. Gradient ascent on the model's parameters alpha raises the probability that the next fixation, drawn
from a softmax, lands on a target.

Run it from a checkout: python -m examples.finetune_observation
"""

import argparse
import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import semfov


@dataclass(frozen=True)
class Looks:
    """The detections from some cells of a scene, and the cells that contain each target."""

    grid: semfov.Grid
    cells: Tensor
    detections: semfov.Detections
    goals: dict[int, Tensor]


def looks_at(scenes: semfov.EmbeddedScenes, eye: semfov.Eye, starts: int) -> list[Looks]:
    """Look at every scene from a few cells. The detections never change, so they are computed once."""
    looks = []
    for index in range(len(scenes)):
        scene = scenes[index]
        grid = semfov.Grid(10, 10, scene.size)
        cells = torch.randperm(len(grid), generator=torch.Generator().manual_seed(index))[:starts]
        covered = grid.footprint(scene.boxes)
        goals = {target: covered[scene.labels == target].any(0) for target in scenes.targets(index)}
        with torch.no_grad():
            detections = eye(scene.image[None], grid.centres[cells])
        looks.append(Looks(grid, cells, detections, goals))
    return looks


def chance_of_hit(model: semfov.FovealObservationModel, looks: Looks, sharpness: float) -> Tensor:
    """Compute the probability that the next fixation, drawn from a softmax over the posterior, lands on the target."""
    grid = looks.grid
    observer = semfov.observers.Semantic(len(model.classes) + 1, model)
    start = observer.start(len(looks.cells), grid, looks.detections.scores)
    belief = observer(start, looks.detections, grid.centres[looks.cells], grid)
    visited = torch.nn.functional.one_hot(looks.cells, len(grid)).bool()
    hits = []
    for target, goal in looks.goals.items():
        values = belief.probability(target).clamp(min=1e-9).log()
        choice = (sharpness * values).masked_fill(visited, -torch.inf).softmax(-1)  # (starts, X·Y)
        hit = choice[:, goal].sum(-1)
        hits.append(hit[~goal[looks.cells]])  # a search that begins at the target needs no shift
    return torch.cat(hits)


def train(model: semfov.FovealObservationModel, looks: Sequence[Looks], steps: int) -> None:
    """Raise the chance of a hit by gradient ascent on α."""
    optimiser = torch.optim.Adam([model.log_alpha], lr=0.02)
    for step in range(steps):
        optimiser.zero_grad()
        hits = torch.cat([chance_of_hit(model, look, 3.0) for look in looks])
        loss = -hits.clamp(min=1e-6).log().mean()
        loss.backward()
        optimiser.step()
        if step % 10 == 0:
            percent = 100 * float(hits.mean().detach())
            print(f"step {step:3d}: probability of a hit at the next fixation {percent:.1f} %")


def main() -> None:
    """Train on some embedded scenes and evaluate on others."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=6, help="training scenes, and as many test scenes (default: 6)")
    parser.add_argument("--starts", type=int, default=12, help="first fixations in each scene (default: 12)")
    parser.add_argument("--steps", type=int, default=30, help="steps of Adam (default: 30)")
    arguments = parser.parse_args()

    detector = semfov.load_detector("yolox-nano")
    eye = semfov.Eye(semfov.Foveation(100.0), detector).requires_grad_(False)
    count = arguments.scenes
    training = looks_at(semfov.EmbeddedScenes(detector.classes, count=count, seed=1), eye, arguments.starts)
    test = looks_at(semfov.EmbeddedScenes(detector.classes, count=count, seed=2), eye, arguments.starts)
    published = semfov.FovealObservationModel.from_pretrained("yolox-nano-published")
    model = copy.deepcopy(published).train()
    train(model, training, arguments.steps)
    model.eval()
    with torch.no_grad():
        for name, tested in (("before", published), ("after", model)):
            hits = torch.cat([chance_of_hit(tested, look, 30.0) for look in test])
            print(f"{name} training, on other scenes: {100 * float(hits.mean()):.1f} %")


if __name__ == "__main__":
    main()
