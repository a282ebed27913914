"""One-step lookahead: the belief about all cells after a look with expected or randomly drawn scores."""

from abc import abstractmethod
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from semfov.belief.belief import Belief, dirichlet_belief, one_by_one
from semfov.belief.grid import Grid
from semfov.errors import InputError, check, check_shape, check_whole, values_known
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.observation.foveal import FovealObservationModel
from semfov.precision import exact_product
from semfov.threads import one_thread_if_small

_BLOCK = 1 << 16  # elements that are worked on at once, which stay in the processor's cache
_PRODUCT = 7 << 20  # elements that one product gives; the C library keeps freed memory of up to 32 MB
_PAIRS = 1 << 22  # values of a seen cell for a fixation that are looked up at once
_GOLDEN = (5**0.5 - 1) / 2  # multiples of it, modulo 1, cover [0, 1) evenly, however many there are


class Outlook(NamedTuple):
    """The present belief about cells, and the beliefs after a simulated look from each of N levels of distance.

    Attributes:
        beta: Dirichlet parameters of the present belief, `(..., X·Y, K+1)`.
        total: their sums T, `(..., X·Y)`.
        mean: their mean p, `(..., X·Y, K+1)`.
        likelihood: likelihoods of the looks, `(..., X·Y, N, K+1)`.
        scale: means of the likelihoods under the present belief, `(..., X·Y, N, 1)`; r is likelihood over scale.
    """

    beta: Tensor
    total: Tensor
    mean: Tensor
    likelihood: Tensor
    scale: Tensor

    @property
    def growth(self) -> Tensor:
        """Relative change of the mean, `p' / p - 1 = (r - 1) / (T + 1)`, `(..., X·Y, N, K+1)`."""
        return (self.likelihood / self.scale - 1) / (self.total[..., None, None] + 1)

    @property
    def next_mean(self) -> Tensor:
        """Mean after the look, `p' = p (T + r) / (T + 1)`, `(..., X·Y, N, K+1)`."""
        return torch.addcmul(self.mean[..., None, :], self.mean[..., None, :], self.growth)

    @property
    def next_total(self) -> Tensor:
        """Sum of the parameters after Kaplan's update, `T' = (T + 1) / (1 + min r / T)`, `(..., X·Y, N)`."""
        total = self.total[..., None]
        least = self.likelihood.amin(-1) / self.scale[..., 0]
        return (total + 1) / (1 + least / total)

    @property
    def next_beta(self) -> Tensor:
        """Parameters after Kaplan's update, `β' = β + β (r - min r) / (T + min r)`, `(..., X·Y, N, K+1)`."""
        beta = self.beta[..., None, :]
        least = self.likelihood.amin(-1, keepdim=True)
        # Likelihoods are not divided by their scale: that would be one more pass over the largest tensor.
        sum_of_both = self.total[..., None, None] * self.scale + least
        share = (self.likelihood - least).mul_(1 / sum_of_both)
        return torch.addcmul(beta, beta, share)


def look_ahead(beta: Tensor, expected: Tensor) -> Outlook:
    r"""Simulate Kaplan's update of every cell with the expected scores.

    .. math:: \bar S_n = \sum_k p_k \, E[S \mid k, n], \qquad p'_k = \frac{T p_k + p_k r_k}{T + 1}, \quad
              r_k = \frac{\bar S_{n,k}}{\sum_j p_j \bar S_{n,j}}

    The expected scores enter Kaplan's rule without calibration (Luzio, Bernardino and Moreno, 2024, the equation of
    :math:`\bar S^x`, "which can then be applied with Kaplan's rule").

    Args:
        beta: the present belief, `(..., X·Y, K+1)`.
        expected: E[S | k, n], `(K+1, N, K+1)`.

    Returns:
        The belief after a look from each level.
    """
    total, mean = _total_and_mean(beta)
    return _outlook(beta, total, mean, _expected_looks(mean, expected))


def _total_and_mean(beta: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the sums `(..., X·Y)` of the parameters of a belief, and its means."""
    total = beta.sum(-1)
    return total, beta / total[..., None]


def _expected_looks(mean: Tensor, expected: Tensor) -> Tensor:
    """Compute the expected scores of a look at every cell from every level.

    Args:
        mean: class probabilities of the cells, `(..., X·Y, K+1)`.
        expected: E[S | k, n], `(K+1, N, K+1)`.

    Returns:
        `(..., X·Y, N, K+1)`.
    """
    components = mean.shape[-1]
    check(expected.shape[0] == components, "model", f"{components} classes, as the belief has", expected.shape[0])
    table = expected.to(mean).flatten(1)  # (K+1, N (K+1))

    def scores_of(maps: Tensor) -> Tensor:
        return exact_product(maps, table)

    scores = scores_of(mean) if mean.ndim == 2 else one_by_one(scores_of, mean.flatten(0, -3))
    return scores.view(*mean.shape[:-1], *expected.shape[1:])


def _outlook(beta: Tensor, total: Tensor, mean: Tensor, likelihood: Tensor) -> Outlook:
    """Make the belief after looks with these likelihoods, `(..., X·Y, N, K+1)`."""
    scale = exact_product(mean[..., None, :], likelihood.mT).mT  # Σ_k p_k λ_k
    return Outlook(beta, total, mean, likelihood, scale)


def look_ahead_by_samples(beta: Tensor, likelihoods: Tensor, visited: Tensor) -> Outlook:
    r"""Simulate Kaplan's update of every cell with M random looks from the belief, at every level of distance.

    .. math:: k_m \sim p, \qquad \lambda_m = \lambda_{k_m n m}, \qquad E[F] \approx \frac1M \sum_m F(\beta'(\lambda_m))

    The classes are drawn at M equally spaced points of their cumulative distribution. These points move with the number
    of visited cells `(..., X·Y)`, and are the same in all cells, so that cells with the same belief have the same
    value.

    Args:
        beta: the present belief, `(..., X·Y, K+1)`.
        likelihoods: of M looks at each class from each level, `(K+1, N, M, K+1)` (`sampled_likelihoods`).
        visited: cells that were fixated, `(..., X·Y)` boolean.

    Returns:
        The belief after each of the M looks from each level, `(..., X·Y, N M, K+1)`.
    """
    components = beta.shape[-1]
    check_shape(likelihoods, "likelihoods", components, None, None, components)
    total, mean = _total_and_mean(beta)
    sample = torch.arange(likelihoods.shape[2], device=beta.device)
    # Multiples of the golden ratio fill the unit interval evenly, whatever the number of looks.
    start = (visited.sum(-1).to(beta) * _GOLDEN).frac()[..., None, None]
    point = (sample + start) / len(sample)  # (..., 1, M), the same in all cells
    cumulative = mean.cumsum(-1)[..., None, :]  # (..., X·Y, 1, K+1)
    # The class of a point is the number of classes whose cumulative probability lies below it.
    drawn = (point[..., None] >= cumulative).sum(-1).clamp(max=components - 1)
    likelihood = likelihoods.to(beta)[drawn, :, sample]  # (..., X·Y, M, N, K+1)
    by_level_and_sample = likelihood.transpose(-2, -3).flatten(-3, -2)
    return _outlook(beta, total, mean, by_level_and_sample)


def sampled_likelihoods(
    model: FovealObservationModel, samples: int, *, calibrated: bool = True, seed: int = 0
) -> Tensor:
    r"""Sample scores of objects of each class at each level of distance, and compute their likelihoods.

    .. math:: S_{knm} \sim \mathrm{Dir}(\alpha_{kn}), \qquad \lambda_{knm} = P(C = \cdot \mid S_{knm}, n)

    The model's Dirichlets must be densities of the scores, as after a fit by maximum likelihood.

    Args:
        model: the observation model.
        samples: M, number of looks for each class and level.
        calibrated: calibrate the scores; otherwise the likelihoods are the scores S themselves.
        seed: seed of the random generator.

    Returns:
        `(K+1, N, M, K+1)`.

    Raises:
        InputError: the number is out of range, or the model's Dirichlets are no densities of the scores.
    """
    check_whole(samples, "samples", 1, 1 << 16)
    if model.expected is not None:
        raise InputError(
            "model: expected an observation model whose Dirichlets are densities of the scores, such as "
            "'yolox-nano-published', to draw looks from; got one that has expected scores of its own"
        )
    alpha = model.alpha.detach()
    generator = np.random.default_rng(seed)
    shapes = alpha.double().cpu().numpy()[:, :, None].repeat(samples, 2)  # (K+1, N, M, K+1)
    # Gamma variates divided by their sum have a Dirichlet distribution.
    drawn = generator.standard_gamma(shapes)
    scores = torch.from_numpy(drawn / drawn.sum(-1, keepdims=True)).to(alpha)
    if not calibrated:
        return scores
    # A border belongs to the level inside it; the last level has none, and is everything beyond.
    outer = torch.cat([model.edges, model.edges.new_full((1,), torch.inf)])
    distances = outer[None, :, None].expand(scores.shape[:-1])
    return model.calibrate(scores, distances).detach()


class DrawnLooks(nn.Module):
    """Likelihoods of random looks (`sampled_likelihoods`), cached until the observation model changes.

    Args:
        model: the observation model, which is no part of this module.
        samples: M, number of looks for each class and level.
        calibrated: calibrate the scores.

    Raises:
        InputError: as for `sampled_likelihoods`.
    """

    likelihoods: Tensor
    state: Tensor

    def __init__(self, model: FovealObservationModel, samples: int, *, calibrated: bool = True) -> None:
        super().__init__()
        self.samples = samples
        self.calibrated = calibrated
        likelihoods = sampled_likelihoods(model, samples, calibrated=calibrated)
        self.register_buffer("likelihoods", likelihoods, persistent=False)
        self.register_buffer("state", torch.cat(_values_of(model)), persistent=False)  # that these looks are of

    def forward(self, model: FovealObservationModel) -> Tensor:
        """Return the cached looks, or sample new ones if the model has changed.

        In a graph, and for a model in `torch.func`, values cannot be compared, and the looks are those drawn last.

        Args:
            model: the observation model.

        Returns:
            `(K+1, N, M, K+1)`, as from `sampled_likelihoods`.
        """
        values = _values_of(model)
        if not values_known(*values):
            return self.likelihoods
        state = torch.cat(values)
        is_alike = self.state.device == state.device and self.state.dtype == state.dtype
        if not is_alike or not torch.equal(self.state, state):
            self.likelihoods = sampled_likelihoods(model, self.samples, calibrated=self.calibrated)
            self.state = state
        return self.likelihoods


def _values_of(model: FovealObservationModel) -> list[Tensor]:
    """List the parameters and buffers of a model, each of them as a row of numbers."""
    return [value.detach().flatten() for value in (*model.parameters(), *model.buffers())]


class Lookahead(AcquisitionFunction):
    """Base of acquisition functions of exploration that simulate one look from each level of distance."""

    levels: Tensor
    likelihoods: Tensor | None

    def __init__(self, model: FovealObservationModel, grid: Grid, *, likelihoods: Tensor | None = None) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("levels", model.level(grid.cell_distance))
        self.register_buffer("likelihoods", likelihoods, persistent=False)

    @one_thread_if_small
    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Compute the value of fixating each cell, `(..., X·Y)`, for a belief `(..., X·Y, K+1)`."""
        beta = dirichlet_belief(belief).beta
        check_shape(beta, "beta", self.levels.shape[-1], None)
        expected = self.model.expected_scores() if self.likelihoods is None else None
        values = partial(self._values, expected)
        if beta.ndim == 2 or self.levels.ndim > 2:
            return values(beta, visited)
        # One map at a time stays in the processor's cache; a batch at once takes four times as long.
        maps = beta.flatten(0, -3)
        fixated = visited.expand(beta.shape[:-1]).flatten(0, -2)
        return one_by_one(values, maps, fixated).view(beta.shape[:-1])

    def _values(self, expected: Tensor | None, beta: Tensor, visited: Tensor) -> Tensor:
        """Compute the values in maps.

        Args:
            expected: E[S | k, n], `(K+1, N, K+1)`; None for looks that are drawn.
            beta: the present belief, `(..., X·Y, K+1)`.
            visited: cells that were fixated, `(..., X·Y)`.

        Returns:
            `(..., X·Y)`.
        """
        after = self._after_drawn(beta, visited) if expected is None else self._after_expected(beta, expected)
        change = after - self._at_present(beta)[..., None]
        # As many fixations at once as stay in the processor's cache.
        blocks = self.levels.split(_block(_PAIRS, beta, beta.shape[-2]), -1)
        return torch.cat([self.pool(at_levels(change, levels)) for levels in blocks], -1)

    def _at_present(self, beta: Tensor) -> Tensor:
        """Compute `present`, a block of cells at a time."""
        blocks = beta.split(_block(_BLOCK, beta, beta.shape[-1]), -2)
        return torch.cat([self.present(cells) for cells in blocks], -1)

    def _after_expected(self, beta: Tensor, expected: Tensor) -> Tensor:
        """Compute `cell_values` of the looks with the expected scores, a block of cells and of levels at a time.

        Args:
            beta: the present belief, `(..., X·Y, K+1)`.
            expected: E[S | k, n], `(K+1, N, K+1)`.

        Returns:
            `(..., X·Y, N)`.
        """
        total, mean = _total_and_mean(beta)
        cells = _block(_PRODUCT, beta, beta.shape[-1])
        blocks = zip(beta.split(cells, -2), total.split(cells, -1), mean.split(cells, -2), strict=True)
        rows = []
        for part, part_total, part_mean in blocks:
            columns = []
            for levels in expected.split(_block(_PRODUCT, beta, part.numel()), 1):
                likelihood = _expected_looks(part_mean, levels)
                columns.append(self._by_cells(part, part_total, part_mean, likelihood))
            rows.append(torch.cat(columns, -1))
        return torch.cat(rows, -2)

    def _by_cells(self, beta: Tensor, total: Tensor, mean: Tensor, likelihood: Tensor) -> Tensor:
        """Compute `cell_values` of looks with likelihoods `(..., X·Y, N, K+1)`, a block of cells at a time."""
        cells = _block(_BLOCK, beta, likelihood.shape[-2:].numel())
        blocks = zip(
            beta.split(cells, -2),
            total.split(cells, -1),
            mean.split(cells, -2),
            likelihood.split(cells, -3),
            strict=True,
        )
        return torch.cat([self.cell_values(_outlook(*block)) for block in blocks], -2)

    def _after_drawn(self, beta: Tensor, visited: Tensor) -> Tensor:
        """Compute the mean of `cell_values` over the drawn looks of each level, a block of cells at a time."""
        drawn = self.likelihoods
        assert drawn is not None
        blocks = beta.split(_block(_BLOCK, beta, drawn.shape[1:].numel()), -2)
        values = [self.cell_values(look_ahead_by_samples(cells, drawn, visited)) for cells in blocks]
        # The values of the M looks of a level stand side by side.
        return torch.cat(values, -2).unflatten(-1, drawn.shape[1:3]).mean(-1)

    @abstractmethod
    def cell_values(self, outlook: Outlook) -> Tensor:
        """Compute the value of each cell after a look from each level, `(..., X·Y, N)`; `present` is not subtracted."""

    def present(self, beta: Tensor) -> Tensor:
        """Compute the value of the present belief about each cell, `(..., X·Y)`; `cell_values` minus it is the gain."""
        return beta.new_zeros(beta.shape[:-1])

    def pool(self, values: Tensor) -> Tensor:
        """Sum the gains `(..., seen cell, fixation)` over seen cells: the value of each fixation, `(..., X·Y)`."""
        return values.sum(-2)


def _block(limit: int, maps: Tensor, elements: int) -> int:
    """Count how many things of so many elements are worked on at once: up to the limit on a CPU, else all."""
    if values_known(maps) and maps.device.type == "cpu":
        return max(1, limit // max(1, elements))
    return 1 << 40


def at_levels(values: Tensor, levels: Tensor) -> Tensor:
    """Look up the value of every cell at its level of distance from each fixation.

    Args:
        values: `(..., X·Y, N)`, of each cell from each level.
        levels: `(..., X·Y, X·Y)`, level of each cell from each fixation.

    Returns:
        `(..., X·Y, X·Y)`, by seen cell and fixation.
    """
    index = levels.expand(*values.shape[:-1], levels.shape[-1])
    return values.gather(-1, index)
