"""Maximum-likelihood fit of many Dirichlets at once, from their mean log scores."""

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch
from torch import Tensor

from semfov.errors import SemfovError, check, check_finite, check_shape, lookup
from semfov.observation.descent import Lbfgs

Method = Literal["newton", "fixed_point", "gradient"]

# The first guess of ψ⁻¹(y) uses ψ(x) ≈ -1/x - γ for y below this, and ψ(x) ≈ ln(x - 1/2) above it (Minka 2000).
_KNEE = -2.22
_EULER = 0.5772156649015329
# Σ exp(mean_log) may exceed 1 by this much through rounding, where the statistics came in float32.
_FEASIBLE = 1e-5
# Largest change of the logarithm of a parameter in one step.
_LONGEST = 2.0
# Newton steps that change every parameter by less than a tenth are taken without a line search.
_SAFE = 0.1
_ROUNDS = 60


def mle(mean_log: Tensor, *, method: Method = "newton", max_precision: float = 1e8) -> Tensor:
    r"""Fit Dirichlets by maximum likelihood, given the mean logarithms of their samples.

    .. math:: \max_\alpha \; \ln\Gamma(A) - \sum_k \ln\Gamma(\alpha_k) + \sum_k (\alpha_k - 1) g_k, \quad
              A = \sum_k \alpha_k, \quad g_k = \frac{1}{n} \sum_i \ln s_{ik}

    The objective is concave and has a maximum if `Σ exp(g) < 1`. All methods find the same maximum:

    - `newton`: Newton's method. The Hessian is diagonal plus rank one, so a step costs O(K) (Minka 2000, "Estimating a
      Dirichlet distribution", equations 15 to 18). Steps are taken on `ln α`, which keeps α positive, and halved until
      the likelihood does not fall.
    - `fixed_point`: iterate `ψ(α_k) = ψ(A) + g_k` (Minka 2000, equation 9). The plain iteration keeps a fixed share
      of the error in each round, nearly all of it if A is large. This share can be computed, so each round here
      extrapolates A to the limit.
    - `gradient`: L-BFGS on `ln α`, in coordinates in which the Fisher information is the identity.

    Luzio, Bernardino and Moreno (2024) use "a simple and efficient iterative method, proposed by Minka", without
    saying which of his two.

    Identical samples have `Σ exp(g) = 1` and an unbounded likelihood. The precision A is therefore limited to
    `max_precision`; at the limit the result is the maximum among Dirichlets of that precision.

    Computed in float64. Differentiable once in `mean_log`, by the implicit function theorem.

    Args:
        mean_log: `(..., K)`, K ≥ 2; mean log scores. Use `semfov.dirichlet.floor` for scores with zeros, and
            `semfov.dirichlet.shrink` for little or no data.
        method: `newton`, `fixed_point` or `gradient`.
        max_precision: upper bound of A, positive.

    Returns:
        α, `(..., K)`.

    Raises:
        InputError: `mean_log` is not finite, or no samples on the simplex can have it; or a setting is out of range.
        SemfovError: the method has not converged.

    >>> mle(torch.tensor([-1.0, -1.0]))
    tensor([1., 1.])
    """
    check_shape(mean_log, "mean_log", None)
    components = mean_log.shape[-1]
    check(components >= 2, "mean_log", "at least 2 components", components)
    check_finite(mean_log, "mean_log")
    check(max_precision > 0, "max_precision", "a positive number", max_precision)
    solve = _METHODS[lookup(method, get_args(Method), "method")]
    rows = mean_log.detach().to(torch.float64).reshape(-1, components)
    _check_feasible(rows)

    capped = _are_capped(rows, max_precision)
    alpha = torch.empty_like(rows)
    alpha[capped] = _at_precision(rows[capped], max_precision)
    # L-BFGS needs gradients of its own, which inference mode does not record.
    with torch.inference_mode(False):
        solved = solve(rows[~capped].clone())
    alpha[~capped] = solved
    if mean_log.requires_grad and torch.is_grad_enabled():
        # The difference is 0, and its gradient is that of the solution.
        change = mean_log.to(torch.float64).reshape(-1, components) - rows
        alpha = alpha + _response(alpha, change, capped)
    return alpha.reshape(mean_log.shape).to(mean_log.dtype)


def _check_feasible(rows: Tensor) -> None:
    """Raise `InputError` for mean logarithms `(N, K)` that no scores have which sum to 1."""
    largest = float(rows.exp().sum(-1).max()) if len(rows) else 0.0
    expected = "mean logarithms of scores that sum to 1, so Σ exp(mean_log) up to 1"
    check(largest <= 1 + _FEASIBLE, "mean_log", expected, f"Σ exp(mean_log) = {largest}")


def _are_capped(rows: Tensor, max_precision: float) -> Tensor:
    """Tell for which mean logarithms `(N, K)` the maximum has at least the largest precision, `(N,)` boolean.

    The solution is the root of A = Σ ψ⁻¹(ψ(A) + g). Below the root the right side exceeds the left.
    """
    # The right side never exceeds A Σ exp(g) + K/2: so most rows are known to stay below the largest precision.
    slack = 1 - rows.exp().sum(-1)
    capped = slack <= rows.shape[-1] / (2 * max_precision)
    doubtful = capped.clone()
    level = rows.new_tensor(max_precision).digamma()
    precision = inverse_digamma(level + rows[doubtful]).sum(-1)
    capped[doubtful] = precision >= max_precision
    return capped


def shrink(mean_log: Tensor, count: Tensor, parent: Tensor, strength: float) -> Tensor:
    r"""Shrink the mean log scores of cells with little data towards those of a parent, by pseudo-counts.

    .. math:: g = \frac{n \bar g + w \, g_0}{n + w}

    The maximum-likelihood fit of the result is the maximum a posteriori estimate under the conjugate prior of `w`
    samples with mean log score `g_0`. If the parent is feasible, `Σ exp(g_0) < 1`, then so is the result, for any
    data.

    Args:
        mean_log: `(..., K)`, mean log scores of the cells; ignored where `count` is 0.
        count: `(...)`, number of samples n of each cell.
        parent: `(..., K)`, mean log scores of the parent.
        strength: pseudo-counts w, positive.

    Returns:
        `(..., K)`, g.

    Raises:
        InputError: `strength` is not positive.

    >>> shrink(torch.tensor([-2.0, -1.0]), torch.tensor(1), torch.tensor([-1.0, -1.0]), 1.0)
    tensor([-1.5000, -1.0000])
    """
    check(strength > 0, "strength", "a positive number of pseudo-counts", strength)
    count = count.to(mean_log.dtype)[..., None]
    share = count / (count + strength)
    return parent + share * torch.where(share > 0, mean_log - parent, 0.0)


def vacuous(components: int) -> Tensor:
    """Compute the mean log scores of Dir(1, ..., 1), the uniform density on the simplex: `ψ(1) - ψ(K)`.

    Args:
        components: K, the length of the score vectors.

    Returns:
        `(K,)` in float64.

    >>> mle(vacuous(3))
    tensor([1.0000, 1.0000, 1.0000], dtype=torch.float64)
    """
    digamma = torch.tensor([1.0, components], dtype=torch.float64).digamma()
    return (digamma[0] - digamma[1]).expand(components).clone()


def inverse_digamma(y: Tensor) -> Tensor:
    """Invert the digamma function: find the positive x with ψ(x) = y, by Newton's method (Minka 2000, appendix C).

    Args:
        y: `(...)`, any numbers.

    Returns:
        `(...)`, x.

    >>> inverse_digamma(torch.digamma(torch.tensor([0.01, 1.0, 100.0], dtype=torch.float64)))
    tensor([1.0000e-02, 1.0000e+00, 1.0000e+02], dtype=torch.float64)
    """
    x = _guess(y)
    for _ in range(5):
        x = x - (x.digamma() - y) / torch.polygamma(1, x)
    return x


def _guess(y: Tensor) -> Tensor:
    """Guess the inverse of the digamma function: two asymptotes that meet at `_KNEE`."""
    of_large = y.exp() + 0.5  # ψ(x) is about ln(x - 1/2)
    of_small = -1 / (y.clamp(max=_KNEE) + _EULER)  # ψ(x) is about -1/x - γ
    return torch.where(y >= _KNEE, of_large, of_small)


def _at_precision(rows: Tensor, precision: float) -> Tensor:
    """Find the maximum under the constraint Σ α = precision: ψ(α_k) = y + g_k, with y chosen to satisfy it.

    Args:
        rows: g, `(N, K)`.
        precision: the sum.

    Returns:
        α, `(N, K)`.
    """
    level = math.log(precision) - rows.logsumexp(-1, keepdim=True)
    for _ in range(_ROUNDS):
        alpha = inverse_digamma(level + rows)
        total = alpha.sum(-1, keepdim=True)
        # Newton's method on ln Σ α, whose derivative by y is the sum of 1 / ψ'(α) over Σ α.
        rates = torch.polygamma(1, alpha).reciprocal()
        step = (precision / total).log() * total / rates.sum(-1, keepdim=True)
        level = level + step
        has_converged = step.abs() <= 1e-12 * level.abs().clamp(min=1)
        if bool(has_converged.all()):
            break
    return alpha * (precision / total)


def _first_guess(rows: Tensor) -> Tensor:
    """Guess α within about ten per cent: A = Σ ψ⁻¹(ψ(A) + g), solved with an approximate inverse of ψ.

    Args:
        rows: g, `(N, K)`.

    Returns:
        α, `(N, K)`.
    """
    # For large A the slack 1 - Σ exp(g) is about (K - 1) / 2A.
    slack = -torch.expm1(rows.logsumexp(-1, keepdim=True))
    slack = slack.clamp(min=torch.finfo(rows.dtype).eps)
    log_precision = ((rows.shape[-1] - 1) / 2 / slack).log()
    for _ in range(3):
        # Newton's method on ln A.
        precision = log_precision.exp()
        level = precision.digamma() + rows
        alpha = _guess(level)
        rates = torch.where(level >= _KNEE, alpha - 0.5, alpha.square())  # dα / d level
        total = alpha.sum(-1, keepdim=True)
        total_rate = rates.sum(-1, keepdim=True)
        slope = precision * torch.polygamma(1, precision) * total_rate / total - 1
        step = (total.log() - log_precision) / slope.clamp(max=-1e-9)
        log_precision = log_precision - step.clamp(-_LONGEST, _LONGEST)
    return _guess(log_precision.exp().digamma() + rows)


def _residual(alpha: Tensor, rows: Tensor) -> Tensor:
    """Compute the gradient of the mean log likelihood with respect to α: ψ(A) - ψ(α_k) + g_k."""
    return alpha.sum(-1, keepdim=True).digamma() - alpha.digamma() + rows


def _response(alpha: Tensor, change: Tensor, capped: Tensor | None = None) -> Tensor:
    """Solve `(diag ψ'(α) - ψ'(A)) x = change`; for rows that are `capped` under the constraint Σ x = 0."""
    rates = torch.polygamma(1, alpha).reciprocal()
    total = rates.sum(-1, keepdim=True)
    precision = alpha.sum(-1, keepdim=True)
    # The matrix is diagonal plus rank one: the Sherman-Morrison formula inverts it.
    outer = 1 / (1 / torch.polygamma(1, precision) - total)
    if capped is not None:
        outer = torch.where(capped[:, None], -1 / total, outer)
    direct = rates * change
    return direct + rates * outer * direct.sum(-1, keepdim=True)


def _tolerance(precision: Tensor) -> Tensor:
    """Give the relative change of α at which iterations stop; rounding of ψ alone causes about 1e-15 A."""
    return 1e-8 + 1e-14 * precision


def _objective(alpha: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean log likelihood of each row, without the constant Σ g, and a bound on its rounding error."""
    of_total = alpha.sum(-1).lgamma()
    of_each = alpha.lgamma()
    linear = alpha * rows
    value = of_total + (linear - of_each).sum(-1)
    size = of_total.abs() + (of_each.abs() + linear.abs()).sum(-1)
    return value, 16 * torch.finfo(alpha.dtype).eps * size


def _newton(rows: Tensor) -> Tensor:
    """Maximise by Newton's method on ln α; rows that have converged leave the iteration."""
    result = _first_guess(rows)
    active = torch.arange(len(rows), device=rows.device)
    alpha = result.clone()
    for _ in range(_ROUNDS):
        step = _response(alpha, _residual(alpha, rows)) / alpha  # d ln α = dα / α
        length = step.abs().amax(-1)
        # Indices: a GPU is waited for whenever a mask is used.
        going = (length > _tolerance(alpha.sum(-1))).nonzero()[:, 0]
        long = (length > _SAFE).nonzero()[:, 0]
        step[long] = _climbing(alpha[long], step[long], rows[long])
        alpha = alpha * step.exp()
        result[active] = alpha
        active = active[going]
        alpha = alpha[going]
        rows = rows[going]
        if len(active) == 0:
            return result
    raise _not_converged("newton", len(active))


def _climbing(alpha: Tensor, step: Tensor, rows: Tensor) -> Tensor:
    """Shorten each step on ln α to at most `_LONGEST`, then halve it until the likelihood does not fall."""
    step = step * (_LONGEST / step.abs().amax(-1, keepdim=True)).clamp(max=1.0)
    value, rounding = _objective(alpha, rows)
    for _ in range(_ROUNDS if len(rows) else 0):
        falls = _objective(alpha * step.exp(), rows)[0] < value - rounding
        if not bool(falls.any()):
            break
        step = torch.where(falls[:, None], step / 2, step)
    return step


def _fixed_point(rows: Tensor) -> Tensor:
    """Maximise by Minka's fixed-point iteration, extrapolated; rows that have converged leave the iteration.

    Args:
        rows: g, `(N, K)`.

    Returns:
        α, `(N, K)`.
    """
    result = torch.empty_like(rows)
    active = torch.arange(len(rows), device=rows.device)
    precision = _first_guess(rows).sum(-1)
    for _ in range(_ROUNDS):
        alpha = inverse_digamma(precision.digamma()[:, None] + rows)
        result[active] = alpha
        total = alpha.sum(-1)
        # Share of an error that is left after the round: d ln(Σ α) / d ln(A).
        total_rate = torch.polygamma(1, alpha).reciprocal().sum(-1)
        share = precision * torch.polygamma(1, precision) * total_rate / total
        # The changes of all further rounds are a geometric series.
        change = (total / precision).log()
        step = change / (1 - share).clamp(min=torch.finfo(rows.dtype).eps)
        going = step.abs() > _tolerance(total)
        precision = precision * step.clamp(-_LONGEST, _LONGEST).exp()
        precision = precision[going]
        active = active[going]
        rows = rows[going]
        if len(active) == 0:
            return result
    raise _not_converged("fixed_point", len(active))


def _gradient(rows: Tensor) -> Tensor:
    """Maximise by L-BFGS, started anew until a step of Newton's method would be short."""
    alpha = _first_guess(rows)
    if not len(rows):
        return alpha
    distance = torch.inf
    for _ in range(_ROUNDS):
        # Close to the maximum the likelihood changes by less than its rounding error, so a line search would stall.
        line_search = "strong_wolfe" if distance > 1e-3 else None
        alpha = _descend(alpha, rows, line_search)
        step = (_response(alpha, _residual(alpha, rows)) / alpha).abs().amax(-1)
        if bool((step <= _tolerance(alpha.sum(-1))).all()):
            return alpha
        distance = float(step.max())
    raise _not_converged("gradient", len(rows))


def _descend(start: Tensor, rows: Tensor, line_search: str | None) -> Tensor:
    """Run L-BFGS on ln α, in coordinates in which the Fisher information `diag(α² ψ'(α)) - ψ'(A) α αᵀ` is 1."""
    rates = torch.polygamma(1, start).reciprocal()
    total = rates.sum(-1, keepdim=True)
    precision = start.sum(-1, keepdim=True)
    rest = (1 - torch.polygamma(1, precision) * total).clamp(min=torch.finfo(rows.dtype).eps)
    offset_scale = rates.sqrt() / start
    shift_scale = rates / start * (total * rest).rsqrt()
    offset = torch.zeros_like(rows, requires_grad=True)
    shift = torch.zeros_like(total, requires_grad=True)
    of_total = start.sum(-1).lgamma()
    of_each = start.lgamma()
    optimiser = Lbfgs(
        [offset, shift], max_iter=25, tolerance_grad=1e-13, tolerance_change=0, line_search_fn=line_search
    )

    def current() -> Tensor:
        """Compute α from the variables."""
        return start * (offset * offset_scale + shift * shift_scale).exp()

    @torch.enable_grad()
    def loss() -> Tensor:
        """Compute how much less likely than the start α is, and the gradient."""
        optimiser.zero_grad()
        alpha = current()
        # Differences are taken term by term: the difference of two sums would lose digits.
        linear = ((alpha - start) * rows).sum(-1)
        gain_of_total = alpha.sum(-1).lgamma() - of_total
        loss_of_each = (alpha.lgamma() - of_each).sum(-1)
        gain = gain_of_total - loss_of_each + linear
        decrease = -gain.sum()
        decrease.backward()
        return decrease

    optimiser.step(loss)
    return current().detach()


def _not_converged(method: str, rows: int) -> SemfovError:
    """Make the error of a method that did not converge for some rows."""
    return SemfovError(
        f"mle: expected method {method!r} to converge within {_ROUNDS} rounds, got {rows} Dirichlets that did not; "
        "try another method"
    )


_METHODS: dict[str, Callable[[Tensor], Tensor]] = {
    "newton": _newton,
    "fixed_point": _fixed_point,
    "gradient": _gradient,
}
