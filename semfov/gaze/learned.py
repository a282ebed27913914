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

    ψ are the `gaze_features` of all cells, and h is a convolutional network whose receptive field is the 7 × 7 cells
    around each cell. Before training, h = 0, and the policy equals non-predictive search (`TargetPosterior`).

    The policy is trained on one belief, and its settings are kept with the model: `observer` makes that belief.

    Args:
        width: number of channels of h.
        belief: settings of the belief that the policy reads (of `Semantic`, with raw scores as likelihoods).
        metadata: JSON values to keep with the model: `detector` and `sensor`, the settings it was trained for.

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
        """Values ℓ of all cells.

        Args:
            belief: Dirichlet belief `(B, X·Y, C)` after at least one look.
            visited: `(B, X·Y)` boolean, cells that were fixated.
            target: class 1..K, or a tensor `(B,)` with one for each episode.
            columns: number of cells in a row.

        Returns:
            `(B, X·Y)`, differentiable in the belief and the parameters.
        """
        present = belief.probability(target).log()
        features = gaze_features(belief, visited, target, columns)
        correction: Tensor = self.network(features.mT.unflatten(-1, (-1, columns)))
        return self.log_scale.exp() * present + correction[:, 0].flatten(1)

    def observer(self, components: int) -> Semantic:
        """Make the belief that the policy was trained on.

        Args:
            components: number of classes, background included (K + 1).

        Returns:
            The observer that keeps this belief.
        """
        return Semantic(components, **self.belief)

    def _record(self) -> dict[str, Any]:
        """Width of the network, and settings of the belief that it reads."""
        return {"width": self.width, "belief": self.belief}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The network from a file's record and tensors."""
        model = cls(record["width"], belief=record["belief"], metadata=record["metadata"])
        model.load_state_dict(tensors)
        return model


class LearnedAcquisition(AcquisitionFunction):
    """`LearnedGaze` as the acquisition function of one search.

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
    r"""Features of every cell that the learned policy reads; their meaning is the same for every target class.

    With :math:`p = \beta / T`, :math:`T = \sum_k \beta_k` and C classes the features of a cell are, in this order and
    each scaled to about unit size:

    1. :math:`\ln C p` of the target,
    2. :math:`\ln C p` of background,
    3. :math:`\ln C p` of the most probable other class,
    4. the first feature minus its highest value in the cells not visited,
    5. one minus the entropy of the cell as a fraction of that of C equally probable classes,
    6. T minus the smallest T of all cells,
    7. the distance to the closest fixation,
    8. whether the cell was visited,
    9. the number of visited cells,
    10. the squared distance from the middle of the image,
    11. the row,
    12. 1, which lets a convolution recognise the border.

    A look changes a belief about many classes only a little by Kaplan's rule. The first six therefore pass through
    :math:`\sinh^{-1}(100 x) / 2`, which resolves differences of a hundredth and bounds large values.

    Args:
        belief: the belief, `(B, X·Y, C)`, after at least one look.
        visited: `(B, X·Y)` boolean, cells that were fixated.
        target: class 1..K, or a tensor `(B,)` with one for each episode.
        columns: number of cells in a row.

    Returns:
        `(B, X·Y, 12)`.
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
