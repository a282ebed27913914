"""A gaze policy learned end to end: a small network over the grid of beliefs."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Self, get_args

import torch
from torch import Tensor, nn

from semfov.belief.belief import Belief, DirichletBelief, dirichlet_belief, one_by_one, pick
from semfov.belief.grid import Footprint, Grid
from semfov.belief.observers.semantic import Memory, Semantic
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.io.pretrained import PretrainedForEye
from semfov.io.schema import Field, Number, Object, Schema, Text, convolution

FEATURES = 12


class LearnedGaze(PretrainedForEye):
    r"""Where to look next for a target, learned by backpropagation through whole searches (`train.fit_gaze`).

    .. math:: \ell(x) = s \ln p_t(x) + h(\psi)(x), \qquad f = \arg\max_{x \notin \mathcal V} \ell(x)

    with ψ the `gaze_features` of all cells and h a convolutional network that sees five cells around. It starts with
    h = 0, as non-predictive search (`TargetPosterior`), and training moves it from there.

    The policy is trained behind one belief, and comes with it: `observer` makes it.

    Args:
        width: channels of h.
        belief: settings of the belief that it reads (of `Semantic`); raw scores are likelihoods.
        metadata: JSON values kept with the model: `detector` and `sensor` (settings it was trained for).

    >>> gaze = LearnedGaze()
    >>> sum(p.numel() for p in gaze.parameters())
    1466
    """

    kind: ClassVar[str] = "learned-gaze"
    title: ClassVar[str] = "learned gaze policy"
    shipped: ClassVar[Path] = Path(__file__).parent / "models"
    schema: ClassVar[Schema] = Schema(
        {
            "log_scale": Field((), low=-20, high=20),
            **convolution("network.0", FEATURES, "W", 3),
            **convolution("network.2", "W", "W", 3),
            **convolution("network.4", "W", 1, 1),
        },
        {
            "width": Number(size="W"),
            "belief": Object(
                {
                    "prior": Number(above=0, high=1e6),
                    "tempering": Number(above=0, high=100),
                    "fusion": Text(("kaplan", "product", "sum")),
                    "footprint": Text(get_args(Footprint)),
                    "memory": Text(get_args(Memory)),
                }
            ),
        },
    )

    def __init__(
        self, width: int = 8, *, belief: Mapping[str, Any] | None = None, metadata: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__()
        self.width = width
        self.belief = {"tempering": 0.25, "footprint": "box_centre"} if belief is None else dict(belief)
        self.metadata = dict(metadata or {})
        self.log_scale = nn.Parameter(torch.tensor(math.log(16.0)))
        last = nn.Conv2d(width, 1, 1)
        for parameter in last.parameters():
            nn.init.zeros_(parameter)
        self.network = nn.Sequential(
            nn.Conv2d(FEATURES, width, 3, padding=1),
            nn.GELU(),
            nn.Conv2d(width, width, 3, padding=2, dilation=2),
            nn.GELU(),
            last,
        )

    def forward(self, belief: DirichletBelief, visited: Tensor, target: int | Tensor, columns: int) -> Tensor:
        """Values ℓ of all cells, `(B, X·Y)`; arguments as for `gaze_features`."""
        present = belief.probability(target).log()
        features = gaze_features(belief, visited, target, columns)
        correction: Tensor = self.network(features.mT.unflatten(-1, (-1, columns)))
        return self.log_scale.exp() * present + correction[:, 0].flatten(1)

    def observer(self, components: int) -> Semantic:
        """The belief that it was trained behind, for so many classes, background included."""
        return Semantic(components, **self.belief)

    def _record(self) -> dict[str, Any]:
        """Width of the network, and the belief that it reads."""
        return {"width": self.width, "belief": self.belief}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The network from what was kept."""
        model = cls(record["width"], belief=record["belief"], metadata=record["metadata"])
        model.load_state_dict(tensors)
        return model


class LearnedAcquisition(AcquisitionFunction):
    """`LearnedGaze` for one search.

    Args:
        gaze: the policy.
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        grid: the cells.
    """

    target: Tensor

    def __init__(self, gaze: LearnedGaze, target: int | Tensor, grid: Grid) -> None:
        super().__init__()
        self.gaze = gaze
        self.columns = grid.columns
        self.register_buffer("target", torch.as_tensor(target))

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)` for a belief and the cells `(B, X·Y)` fixated so far."""
        known, target = dirichlet_belief(belief), self.target.expand(len(visited))

        def values(beta: Tensor, closest: Tensor, visited: Tensor, target: Tensor) -> Tensor:
            value: Tensor = self.gaze(DirichletBelief(beta, closest), visited, target, self.columns)
            return value

        return one_by_one(values, known.beta, known.closest, visited, target)


def gaze_features(belief: DirichletBelief, visited: Tensor, target: int | Tensor, columns: int) -> Tensor:
    r"""What a searcher remembers of every cell, `(B, X·Y, 12)`, the same for every class.

    With :math:`p = \beta / T`, :math:`T = \sum_k \beta_k` and C classes they are, each scaled to about unit size:
    :math:`\ln C p` for the target, the background and the most probable other class; the target's against that of the
    best cell not visited; how far the entropy is below that of C equal classes; T against the least of all cells; the
    distance to the closest fixation; whether the cell was visited; how many cells were; the squared distance from the
    middle of the image; the row; and 1, by which a convolution knows the border. Kaplan's rule moves a belief about
    many classes little at a time, so the first six are passed through :math:`\sinh^{-1}(100 x) / 2`, which tells
    hundredths apart and keeps what is large in bounds.

    Args:
        belief: the belief, `(B, X·Y, C)`, after at least one look.
        visited: `(B, X·Y)` boolean.
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        columns: cells in a row.
    """
    beta, target = belief.beta, torch.as_tensor(target, device=belief.beta.device)
    classes = beta.shape[-1]
    total = beta.sum(-1)
    log_p = beta.log() - total.log()[..., None]
    relative = log_p + math.log(classes)
    present = pick(relative, target)
    asked = torch.arange(classes, device=beta.device) == target[..., None, None]
    others = relative.masked_fill(asked, -torch.inf)[..., 1:].amax(-1) if classes > 2 else torch.zeros_like(present)
    best = present.masked_fill(visited, -torch.inf).amax(-1, keepdim=True)
    best = torch.where(best.isfinite(), best, 0.0)
    entropy = -(log_p.exp() * log_p).sum(-1)
    cell = torch.arange(beta.shape[1], device=beta.device)
    rows = beta.shape[1] // columns
    across = (2 * (cell % columns) + 1) / columns - 1
    down = (2 * (cell // columns) + 1) / rows - 1
    fixated = visited.to(beta)
    beliefs = [
        present,
        relative[..., 0],
        others,
        present - best,
        1 - entropy / math.log(classes),
        total - total.amin(-1, keepdim=True),
    ]
    memories = [
        4 * belief.closest,
        fixated,
        (fixated.sum(-1, keepdim=True) / 5).expand_as(present),
        (across.square() + down.square()).to(beta).expand_as(present),
        down.to(beta).expand_as(present),
        torch.ones_like(present),
    ]
    return torch.cat([(100 * torch.stack(beliefs, -1)).asinh() / 2, torch.stack(memories, -1)], -1)
