"""Train a fovea, a network and an observation model together, through the belief of a search.

The network sees a photograph through the fovea, three times, and scores the classes in every cell. The observation
model turns scores into likelihoods by class and distance, the belief fuses the looks, and the loss is the negative log
of the target's share of the belief. Its gradient reaches the width of the fovea, the network and α.

Run it from a checkout: python -m examples.learned_chain
"""

import argparse

import torch
from torch import Tensor, nn
from torch.nn import functional as F

import semfov
from semfov.belief.observers import SemanticSearch

COLUMNS, ROWS = 10, 8  # cells of the map
LOOKS = 3  # looks of a search

Search = tuple[Tensor, int, Tensor]
"""The image, the class to search for, and the cells that hold it."""


class Chain(nn.Module):
    """A fovea, a small network and an observation model, in one module.

    Args:
        classes: names of the classes.
    """

    def __init__(self, classes: tuple[str, ...]) -> None:
        super().__init__()
        components = len(classes) + 1
        edges = [0.1, 0.2, 0.4]
        odds = torch.full((components, len(edges) + 1), 0.1)
        self.fovea = semfov.Foveation(10.0, levels=4, learnable=True)
        self.network = nn.Sequential(
            nn.Conv2d(3, 16, 5, stride=2, padding=2),
            nn.GELU(),
            nn.Conv2d(16, 32, 5, stride=2, padding=2),
            nn.GELU(),
            nn.AdaptiveAvgPool2d((ROWS, COLUMNS)),
            nn.Conv2d(32, components, 3, padding=1),
        )
        self.model = semfov.FovealObservationModel.identity(classes, edges, miss_odds=odds)

    def forward(self, image: Tensor, cells: Tensor, target: int, goal: Tensor) -> Tensor:
        """Search an image `(3, H, W)` from `cells` `(n,)`; returns −ln of the share of the goal `(X·Y,)`, a scalar."""
        grid = semfov.Grid(COLUMNS, ROWS, (image.shape[-1], image.shape[-2]))
        observer = SemanticSearch(self.model)
        belief = observer.start(1, grid, image)
        everywhere = torch.ones(1, len(grid), dtype=torch.bool)
        for fixation in grid.centres[cells].split(1):
            view = self.fovea(image[None], fixation)
            logits = self.network(view)  # (1, K+1, Y, X)
            scores = logits.flatten(2).mT.softmax(-1)  # (1, X·Y, K+1)
            seen = semfov.Detections(grid.edges[None], scores, everywhere)
            belief = observer(belief, seen, fixation, grid)
        share = belief.probability(target)[0].index_fill(0, cells, 0.0)
        return -((share * goal).sum() / share.sum()).log()


def searches_in(scenes: semfov.EmbeddedScenes) -> list[Search]:
    """List the searches in scenes, which are reduced to a quarter of their sides."""
    searches: list[Search] = []
    for index in range(len(scenes)):
        scene = scenes[index]
        image = F.avg_pool2d(scene.image, 4)
        covered = semfov.Grid(COLUMNS, ROWS, scene.size).footprint(scene.boxes)
        searches += [(image, target, covered[scene.labels == target].any(0)) for target in scenes.targets(index)]
    return searches


def first_looks(goal: Tensor, generator: torch.Generator) -> Tensor:
    """Draw cells that do not hold the target."""
    free = (~goal).nonzero()[:, 0]
    return free[torch.randperm(len(free), generator=generator)[:LOOKS]]


@torch.no_grad()
def mean_loss(chain: Chain, searches: list[Search]) -> float:
    """Average the loss of all searches, from cells that do not change."""
    generator = torch.Generator().manual_seed(1)
    losses = [chain(image, first_looks(goal, generator), target, goal) for image, target, goal in searches]
    return float(torch.stack(losses).mean())


def train(chain: Chain, searches: list[Search], steps: int) -> None:
    """Train all parts together."""
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.Adam(chain.parameters(), lr=0.01)
    for _ in range(steps):
        image, target, goal = searches[int(torch.randint(len(searches), (1,), generator=generator))]
        loss = chain(image, first_looks(goal, generator), target, goal)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()


def described(chain: Chain, searches: list[Search]) -> str:
    """Say the mean loss and the width of the fovea."""
    sigma = float(chain.fovea.sigma.detach())
    return f"loss {mean_loss(chain, searches):.2f}, fovea {sigma:.1f} px"


def main() -> None:
    """Train on embedded scenes, and compare the loss before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=6, help="number of embedded scenes")
    parser.add_argument("--steps", type=int, default=100, help="number of training steps")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    scenes = semfov.EmbeddedScenes(("person", "boat", "truck", "car", "horse"), count=arguments.scenes)
    searches = searches_in(scenes)
    chain = Chain(scenes.classes)
    alpha_before = chain.model.alpha.detach()
    print(f"before training: {described(chain, searches)}")
    train(chain, searches, arguments.steps)
    print(f"after training: {described(chain, searches)}")
    change = chain.model.alpha.detach() / alpha_before - 1
    print(f"α changed by up to {float(change.abs().max()):.0%}")


if __name__ == "__main__":
    main()
