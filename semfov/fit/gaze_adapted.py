"""The shipped model of where people look, adapted to other pictures and people by four numbers."""

from collections.abc import Sequence
from copy import deepcopy
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.fit.gaze import GazeFit
from semfov.fit.gaze_folds import Fold, Groups
from semfov.fit.training import descend
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of
from semfov.human.viewing import Viewed, log_centre
from semfov.io.code import modules_digest

_STEPS = 100
_RATE = 0.05


class Adaptation(nn.Module):
    r"""Four numbers by which a model suits other pictures: of its map, of the blur, and of two centre biases.

    .. math:: \ln p(u) = e^a \, (G_{e^b \sigma} * r)(u) + w \, c(u) + v \, c'(u) - \ln Z

    r is the map of the model before its blur G, c its centre bias, and c' the log density of all fixations in the other
    pictures. A readout has thousands of numbers, for which a few dozen pictures are too few. Kümmerer, Khanuja and
    Bethge (Modeling saliency dataset bias, 2025) adapt the few numbers of their model that differ between data sets.

    Args:
        model: the model.

    Shape:
        - readouts: `(P, rows, columns)`, the mean readout of each picture
        - learned: c' for each picture, `(P, rows, columns)`
        - output: `(P, rows, columns)`, log densities over the cells

    >>> adaptation = Adaptation(FixationDensity({"backbone8": 3}))
    >>> flat = torch.zeros(1, 39, 52)
    >>> round(adaptation(flat, flat, (39, 52)).exp().sum().item(), 4)
    1.0
    """

    def __init__(self, model: FixationDensity) -> None:
        super().__init__()
        self.gain = nn.Parameter(torch.zeros(()))  # a
        self.spread = nn.Parameter(torch.zeros(()))  # b
        self.kept = nn.Parameter(torch.ones(()))  # w
        self.learned = nn.Parameter(torch.zeros(()))  # v
        self.model = deepcopy(model).requires_grad_(False)

    def forward(self, readouts: Tensor, learned: Tensor, size: tuple[int, int]) -> Tensor:
        """Compute the log densities of pictures.

        Args:
            readouts: `(P, rows, columns)`, the mean readout of each picture.
            learned: `(P, rows, columns)`, log density of the fixations in the other pictures.
            size: `(height, width)` of the pictures.

        Returns:
            `(P, rows, columns)`.
        """
        maps = self.gain.exp() * blurred(readouts, (self.model.blur + self.spread).exp())
        log_density = maps + self.kept * self.model.centre_bias(size) + self.learned * learned
        return log_density - log_density.flatten(1).logsumexp(1)[:, None, None]

    @torch.no_grad()
    def adapted(self, learned: Tensor) -> FixationDensity:
        """Make the model with these numbers.

        Args:
            learned: log density of the fixations in all pictures, `(rows, columns)`.

        Returns:
            A model of its own.
        """
        model = deepcopy(self.model)
        model.out.mul_(self.gain.exp())
        model.blur.add_(self.spread)
        centre = self.kept * model.centre_weight * _resized(model.centre, learned.shape) + self.learned * learned
        model.centre = centre - centre.logsumexp((0, 1))
        model.centre_weight.fill_(1.0)  # which the centre now has in it
        return model


def adapted_density(
    model: FixationDensity, groups: Sequence[Viewed], pictures: Sequence[Sequence[int]], title: str
) -> FixationDensity:
    """Adapt a model to some pictures of each group by maximum likelihood.

    The centre bias of each picture is that of all others, so that its weight is what it is worth in new pictures.

    Args:
        model: the model.
        groups: pictures of one size each, with everybody's scanpaths.
        pictures: numbers of the pictures of each group, two or more in all.
        title: what it is adapted to, for the progress bar.

    Returns:
        The adapted model, in `eval` mode.
    """
    adaptation = Adaptation(model)
    parts = []
    for group, numbers in zip(groups, pictures, strict=True):
        if len(numbers):
            readouts = _readouts(model, group, numbers)
            centres = _centres_of_others(groups, pictures, group, numbers)
            counts = group.counts[torch.as_tensor(numbers)]
            shares = counts / counts.sum((1, 2), keepdim=True).clamp(min=1)
            parts.append(_GroupToAdapt(group.size, readouts, centres, shares))

    def loss_of(_: int) -> Tensor:
        """Average the negative log likelihood of a fixation over all pictures."""
        losses = []
        for part in parts:
            log_density = adaptation(part.readouts, part.centres, part.size)
            losses.append(-(log_density * part.shares).sum((1, 2)))
        return torch.cat(losses).mean()

    parameters = [adaptation.gain, adaptation.spread, adaptation.kept, adaptation.learned]
    descend(parameters, loss_of, _STEPS, _RATE, decay=0.0, title=title)
    return adaptation.adapted(log_centre(groups, pictures)).eval()


class _GroupToAdapt(NamedTuple):
    """Pictures of one size, to which a model is adapted.

    Attributes:
        size: `(height, width)` of the pictures.
        readouts: `(P, rows, columns)`, what the model reads from each.
        centres: `(P, rows, columns)`, log density of the fixations in all other pictures.
        shares: `(P, rows, columns)`, share of the fixations in each cell.
    """

    size: tuple[int, int]
    readouts: Tensor
    centres: Tensor
    shares: Tensor


@torch.no_grad()
def _readouts(model: FixationDensity, group: Viewed, pictures: Sequence[int]) -> Tensor:
    """Compute the mean readout of each picture, `(P, rows, columns)`."""
    return torch.cat([model.readouts(group.some([picture]), group.size).mean(1) for picture in pictures])


def _centres_of_others(
    groups: Sequence[Viewed], pictures: Sequence[Sequence[int]], group: Viewed, numbers: Sequence[int]
) -> Tensor:
    """Compute the log density of the fixations in all pictures but one, for each of a group, `(P, rows, columns)`."""
    centres = []
    # By its own fixations a picture would be predicted better than any new one.
    for left_out in numbers:
        others = []
        for other_group, of_group in zip(groups, pictures, strict=True):
            is_same = other_group is group
            others.append([number for number in of_group if not (is_same and number == left_out)])
        centres.append(_resized(log_centre(groups, others), cells_of(group.size)))
    return torch.stack(centres)


def _resized(centre: Tensor, cells: Sequence[int]) -> Tensor:
    """Interpolate a centre bias at other cells."""
    return F.interpolate(centre[None, None], tuple(cells), mode="bilinear", align_corners=False)[0, 0]


class AdaptedFold(Fold):
    """A fold whose model is the shipped one, adapted to the other pictures."""

    def __init__(self, groups: Groups, number: int, count: int, settings: GazeFit, shipped: FixationDensity) -> None:
        super().__init__(groups, number, count, settings)
        self.shipped = shipped

    @property
    def what(self) -> dict[str, object]:
        """What models and scores depend on, beside the pictures."""
        return {**super().what, "shipped": self.shipped.metadata, "code": modules_digest(__name__)}

    def fit(self) -> FixationDensity:
        """Adapt the shipped model."""
        return adapted_density(self.shipped, self.groups(), self.fitted(), f"adapting, {self.title}")
