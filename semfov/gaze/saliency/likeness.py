"""How much a picture differs from the pictures of a fit, by statistics of a detector's feature maps."""

from collections.abc import Iterable
from typing import Self

import torch
from torch import Tensor, nn

from semfov.detection import FeatureMaps
from semfov.errors import check, check_shape
from semfov.gaze.saliency.on_picture import sides_of

FEWEST = 30
"""Smallest number of pictures to which a distance is fitted."""

_LEAST = 1e-3  # deviation of a channel whose logarithm is taken, so that a flat one has one


class PictureLikeness(nn.Module):
    r"""Distance of a picture from the pictures of a fit, by mean and deviation of each feature channel.

    .. math:: d^2 = \frac{1}{P} \Big( \sum_k \frac{(v_k^\top z)^2}{\lambda_k}
              + \frac{\|z\|^2 - \sum_k (v_k^\top z)^2}{\sigma^2} \Big)

    z are the P pooled values of the picture, standardised by those of the fit. The Mahalanobis distance is that of a
    covariance with the fit's largest variances :math:`\lambda_k` along its principal axes :math:`v_k`, and one
    variance :math:`\sigma^2` in all other directions (Tipping and Bishop, 1999).

    Args:
        values: number P of pooled values.
        axes: number of principal axes.

    Shape:
        - values: `(B, P)` (`pooled`)
        - output: `(B,)`, the distance :math:`d^2` over the largest one that counts as alike

    >>> likeness = PictureLikeness.fitted(torch.randn(200, 6), axes=2)
    >>> likeness(torch.zeros(1, 6)).item() < 1 < likeness(torch.full((1, 6), 9.0)).item()
    True
    """

    mean: Tensor
    deviation: Tensor
    axes: Tensor
    variance: Tensor
    rest: Tensor
    limit: Tensor

    def __init__(self, values: int, axes: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(values))
        self.register_buffer("deviation", torch.ones(values))
        self.register_buffer("axes", torch.zeros(axes, values))
        self.register_buffer("variance", torch.ones(axes))
        self.register_buffer("rest", torch.tensor(1.0))
        self.register_buffer("limit", torch.tensor(1.0))

    @classmethod
    def fitted(cls, pooled: Tensor, *, axes: int = 4, alike: float = 0.99) -> Self:
        """Fit the distance to the feature maps of pictures.

        The limit is the mean of two: each half of the pictures is measured by the distance that is fitted to the other.

        Args:
            pooled: `(N, P)`, the pooled values of the pictures.
            axes: largest number of principal axes.
            alike: share of such pictures that the distance calls alike.

        Returns:
            The fitted distance.

        Raises:
            InputError: there are too few pictures.
        """
        check(len(pooled) >= FEWEST, "pooled", f"at least {FEWEST} pictures", len(pooled))
        axes = min(axes, pooled.shape[1] - 1)  # a variance for the other directions needs one
        halves = pooled[::2], pooled[1::2]
        limits = [
            cls._described(one, axes)(other).quantile(alike)
            for one, other in zip(halves, reversed(halves), strict=True)
        ]
        likeness = cls._described(pooled, axes)
        likeness.limit = torch.stack(limits).mean()
        return likeness

    @classmethod
    def _described(cls, pooled: Tensor, axes: int) -> Self:
        """Make the distance from pictures `(N, P)` without a limit."""
        likeness = cls(pooled.shape[1], axes)
        likeness.mean = pooled.mean(0)
        likeness.deviation = pooled.std(0, correction=0).clamp(min=_LEAST)
        standard = (pooled - likeness.mean) / likeness.deviation
        _, singular, directions = torch.linalg.svd(standard.double(), full_matrices=False)
        variances = (singular.square() / len(pooled)).to(pooled).clamp(min=_LEAST)
        likeness.axes = directions[:axes].to(pooled)
        likeness.variance = variances[:axes]
        likeness.rest = variances[axes:].sum() / (pooled.shape[1] - axes)
        return likeness

    def forward(self, values: Tensor) -> Tensor:
        """Compute the distances of pictures.

        Args:
            values: `(B, P)`, their pooled values.

        Returns:
            `(B,)`; above 1, a picture is unlike those of the fit.

        Raises:
            InputError: there are more or fewer values.
        """
        check_shape(values, "values", None, len(self.mean))
        standard = (values - self.mean) / self.deviation  # (B, P)
        along = standard @ self.axes.mT  # (B, axes)
        # What no axis explains is divided by its mean variance.
        rest = (standard.square().sum(1) - along.square().sum(1)) / self.rest
        squared_distance = (along.square() / self.variance).sum(1) + rest
        return squared_distance / (len(self.mean) * self.limit)


def pooled(features: FeatureMaps, layers: Iterable[str]) -> Tensor:
    """Compute mean and logarithm of the standard deviation of each channel over pictures.

    Args:
        features: feature maps of the pictures.
        layers: names of the maps.

    Returns:
        `(B, P)`, for each map first its means and then its deviations.
    """
    values = []
    for name in layers:
        maps = features.maps[name]
        rows, columns = sides_of(features, (int(maps.shape[-2]), int(maps.shape[-1])))
        on_picture = maps[..., rows.first : rows.stop, columns.first : columns.stop]
        part = on_picture.float().flatten(2)  # (B, C, pixels)
        means = part.mean(2, keepdim=True)
        # `Tensor.std` along rows takes twenty times as long.
        deviations = torch.linalg.vector_norm(part - means, dim=2) / part.shape[2] ** 0.5
        values += [means[..., 0], deviations.clamp(min=_LEAST).log()]
    return torch.cat(values, 1)
