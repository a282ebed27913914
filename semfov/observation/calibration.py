"""Discriminative fit of an observation model: train the posterior of the class, not the density of the scores."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape
from semfov.observation.descent import Lbfgs
from semfov.observation.dirichlet import floor, log_normaliser
from semfov.observation.foveal import FovealObservationModel


def fit_discriminative(
    model: FovealObservationModel,
    scores: Tensor,
    distance: Tensor,
    labels: Tensor,
    *,
    decay: float = 2000.0,
    level_decay: float = 10000.0,
    bias_decay: float = 10.0,
    iterations: int = 100,
) -> FovealObservationModel:
    r"""Fit a model with a calibrated posterior: its α and π minimise the cross-entropy of the true classes.

    The logits of the posterior are linear in the log scores, `Σ_j (α_kdj - 1) ln s_j + c_kd`. The fit is therefore a
    multinomial logistic regression. It is known as Dirichlet calibration (Kull et al. 2019, "Beyond temperature
    scaling"); here there is one for each level of distance. Requiring positive α costs no generality, because adding
    the same number to the weights of all classes changes nothing.

    With 80 classes there are 82 weights for each class and level, and few examples of most classes, so the priors
    matter. They are normal distributions that tie the levels together. Their centre is the model that returns the
    scores unchanged, `α_k = 1 + e_k`; classes without examples stay there:

    .. math:: \ln \alpha_{kdj} = \ln(1 + \delta_{kj}) + u_{kj} + v_{kdj}, \quad
              u \sim N(0, 1/\texttt{decay}), \; v \sim N(0, 1/\texttt{level\_decay}), \;
              c \sim N(0, 1/\texttt{bias\_decay})

    where `c` is again the sum of a common part and one part for each level. The diagonal of u acts as a temperature of
    each score and has the same weak prior as c. L-BFGS finds the maximum a posteriori on all samples from a fixed
    start, so nothing in the result is random.

    After this fit Dir(α) no longer describes the scores, so the new model keeps the expected scores of `model`. The
    method is not in Luzio, Bernardino and Moreno (2024), whose Dirichlets are fitted to the scores.

    Args:
        model: a fitted model (`FovealObservationModel.fit`); gives the edges, classes, epsilon, metadata, miss rates
            and expected scores.
        scores: `(M, K+1)`, score vectors of detections. The fit is computed in their dtype.
        distance: `(M,)`, from the fixation to the centre of the box, in units of the image's longer side.
        labels: `(M,)`, index of the true class, 0 for background.
        decay: precision of the prior of u off the diagonal.
        level_decay: precision of the prior of v.
        bias_decay: precision of the prior of c and of the diagonal of u.
        iterations: largest number of L-BFGS steps.

    Returns:
        A new model; `model` is not changed.

    Raises:
        InputError: shapes do not fit, a label is out of range, or there are no samples.

    >>> model = FovealObservationModel.identity(["cup"], edges=[0.2])
    >>> overconfident = torch.tensor([0.1, 0.9]).repeat(1000, 1)  # right in 600 of 1000 cases
    >>> labels = torch.arange(1000) % 5 < 3
    >>> trained = fit_discriminative(model, overconfident, torch.zeros(1000), labels.long())
    >>> trained.calibrate(overconfident[0], torch.tensor(0.0)).detach()
    tensor([0.4000, 0.6000])
    """
    components = len(model.classes) + 1
    levels = len(model.edges) + 1
    check_shape(scores, "scores", None, components)
    samples = len(scores)
    check(samples > 0, "scores", "at least one sample", samples)
    check_shape(distance, "distance", samples)
    check_shape(labels, "labels", samples)
    are_inside = bool(((labels >= 0) & (labels < components)).all())
    check(are_inside, "labels", f"class indices from 0 to {components - 1}", "one outside")
    for name, value in (("decay", decay), ("level_decay", level_decay), ("bias_decay", bias_decay)):
        check(value > 0, name, "a positive number", value)

    # Log scores are measured from the floor: those of tiny scores are then close to 0, and L-BFGS converges faster.
    lowest = math.log(model.epsilon)
    evidence = floor(scores.detach(), model.epsilon).log() - lowest
    level = model.level(distance)
    groups = [(evidence[level == n], labels[level == n]) for n in range(levels)]
    unit = torch.eye(components).to(scores)
    common_precision = torch.where(unit[:, None] > 0, bias_decay, decay)
    posterior = _Posterior(groups, unit, common_precision, level_decay, bias_decay)
    optimiser = Lbfgs(
        posterior.variables,
        max_iter=iterations,
        history_size=10,
        tolerance_grad=0.0,
        tolerance_change=1e-9,
        line_search_fn="strong_wolfe",
    )

    def closure() -> Tensor:
        """Compute the mean loss of the samples, and its gradient."""
        optimiser.zero_grad()
        mean = posterior.loss() / samples
        mean.backward()
        return mean

    with torch.enable_grad():
        optimiser.step(closure)
    with torch.no_grad():
        alpha, constant = posterior.parameters()

    # c = ln π - (log normaliser of Dir(α)) + (shift by the floor); solve for ln π.
    shift = log_normaliser(alpha.double()).to(alpha) - (alpha - 1).sum(-1) * lowest
    trained = {"decay": decay, "level_decay": level_decay, "bias_decay": bias_decay, "iterations": iterations}
    return FovealObservationModel(
        alpha,
        model.edges.to(alpha),
        model.classes,
        epsilon=model.epsilon,
        log_prior=constant + shift,
        expected=model.expected_scores().detach(),
        miss_rate=model.miss_rate,
        metadata={**model.metadata, "method": "discriminative", "discriminative": trained},
    )


class _Posterior:
    """The negative log posterior of α and c, as a function of variables that L-BFGS can move freely.

    The variables are u, v, and the common part and the parts by level of c. They are scaled by the curvature of the
    objective at the start, with which L-BFGS converges faster.

    Args:
        groups: by level, log scores above the floor `(M, K+1)` and labels `(M,)`.
        unit: the identity, `(K+1, K+1)`.
        common_precision: of the prior of u, `(K+1, 1, K+1)`.
        level_decay: precision of the prior of v.
        bias_decay: precision of the priors of both parts of c.

    Attributes:
        variables: scaled u, v, and both parts of c, all 0 at the start, where α is 1 + e_k and c is 0.
    """

    def __init__(
        self,
        groups: list[tuple[Tensor, Tensor]],
        unit: Tensor,
        common_precision: Tensor,
        level_decay: float,
        bias_decay: float,
    ) -> None:
        self._groups = groups
        self._start = unit.log1p()[:, None]  # ln(1 + e_k)
        level_precision = unit.new_tensor(level_decay)
        bias_precision = unit.new_tensor(bias_decay)
        self._precisions = [common_precision, level_precision, bias_precision, bias_precision]
        curvatures = _curvatures(groups, self._start.exp())
        self._scales = [(c + p).rsqrt() for c, p in zip(curvatures, self._precisions, strict=True)]
        self.variables = [torch.zeros_like(scale, requires_grad=True) for scale in self._scales]

    def _unscaled(self) -> list[Tensor]:
        """Scale the variables back to u, v, and both parts of c."""
        return [variable * scale for variable, scale in zip(self.variables, self._scales, strict=True)]

    def parameters(self) -> tuple[Tensor, Tensor]:
        """Compute α `(K+1, N, K+1)` and c `(K+1, N)` from the variables."""
        return self._parameters_of(self._unscaled())

    def _parameters_of(self, values: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Compute α and c from u, v, and both parts of c."""
        u, v, common_bias, level_bias = values
        return (self._start + u + v).exp(), common_bias + level_bias

    def loss(self) -> Tensor:
        """Compute the negative log posterior of all samples, without the constants of the priors."""
        values = self._unscaled()
        alpha, constant = self._parameters_of(values)
        penalties = [(p * v.square()).sum() for p, v in zip(self._precisions, values, strict=True)]
        total = torch.stack(penalties).sum() / 2
        for n, (evidence, labels) in enumerate(self._groups):
            logits = F.linear(evidence, alpha[:, n] - 1, constant[:, n])
            total = total + F.cross_entropy(logits, labels, reduction="sum")
        return total


def _curvatures(groups: list[tuple[Tensor, Tensor]], alpha: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Compute the diagonal of the Hessian of the cross-entropy at the start.

    Args:
        groups: log scores `(M_n, K+1)` and labels of the samples of each level.
        alpha: `(K+1, 1, K+1)`, the parameters at the start.

    Returns:
        The curvatures along u `(K+1, 1, K+1)`, v `(K+1, N, K+1)`, the common part of c `(K+1, 1)` and its parts by
        level `(K+1, N)`.
    """
    weights = []
    constants = []
    for rows, _ in groups:
        p = F.linear(rows, alpha[:, 0] - 1).softmax(-1)
        variance = (p * (1 - p)).t()
        weights.append(variance @ rows.square() * alpha[:, 0].square())
        constants.append(variance.sum(-1))
    weight = torch.stack(weights, 1)
    constant = torch.stack(constants, 1)
    return weight.sum(1, keepdim=True), weight, constant.sum(1, keepdim=True), constant
