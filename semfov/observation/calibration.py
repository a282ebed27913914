"""Training an observation model for the posterior of the class, rather than for the density of the scores."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.errors import check, check_shape
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
    r"""A model whose posterior is calibrated: α and π minimise the cross-entropy of the true classes.

    The logits of the posterior are linear in the log scores, `Σ_j (α_kdj - 1) ln s_j + c_kd`, so this is multinomial
    logistic regression, and is known as Dirichlet calibration (Kull et al. 2019, "Beyond temperature scaling"), here
    one for each level of distance. Positive α are no restriction: a shift common to all classes changes nothing.

    With 82 weights a class and level, and few examples of most, priors matter. They are normal, centred on returning
    the scores as they are (`α_k = 1 + e_k`, where classes without examples stay), and tie the levels together:

    .. math:: \ln \alpha_{kdj} = \ln(1 + \delta_{kj}) + u_{kj} + v_{kdj}, \quad
              u \sim N(0, 1/\texttt{decay}), \; v \sim N(0, 1/\texttt{level\_decay}), \;
              c \sim N(0, 1/\texttt{bias\_decay})

    with `c` again the sum of a common part and one for each level. The diagonal of u, which acts as a temperature of
    each score, has the weaker prior of c. The maximum a posteriori is found by L-BFGS on all samples from a fixed
    start, so that the result depends on nothing random.

    Trained so, Dir(α) no longer describes the scores: the expected scores are kept from `model`. The paper of Luzio,
    Bernardino and Moreno (2024) has nothing of the kind: its Dirichlets are fitted to the scores.

    Args:
        model: gives edges, classes, epsilon, metadata, and the expected scores; fitted by `fit`.
        scores: `(M, K+1)`, score vectors of detections. Computed in their dtype.
        distance: `(M,)`, in units of the image's longer side.
        labels: `(M,)`, index of the true class, 0 for background.
        decay: precision of the prior of u, off the diagonal.
        level_decay: precision of the prior of v.
        bias_decay: precision of the prior of c.
        iterations: steps of L-BFGS, at most.

    Returns:
        A new model; `model` stays as it is.

    Raises:
        InputError: shapes do not fit, a label is out of range, or there are no samples.
    """
    components, levels = len(model.classes) + 1, len(model.edges) + 1
    check_shape(scores, "scores", None, components)
    samples = len(scores)
    check(samples > 0, "scores", "at least one sample", samples)
    check_shape(distance, "distance", samples)
    check_shape(labels, "labels", samples)
    inside = bool(((labels >= 0) & (labels < components)).all())
    check(inside, "labels", f"class indices from 0 to {components - 1}", "one outside")
    for name, value in [("decay", decay), ("level_decay", level_decay), ("bias_decay", bias_decay)]:
        check(value > 0, name, "a positive number", value)

    # Measured from the floor, scores that are next to nothing are next to zero, and L-BFGS converges faster.
    lowest = math.log(model.epsilon)
    evidence = floor(scores.detach(), model.epsilon).log() - lowest
    level = model.level(distance)
    groups = [(evidence[level == n], labels[level == n]) for n in range(levels)]

    unit = torch.eye(components).to(scores)
    start = unit.log1p()[:, None]
    weak, tied = scores.new_tensor(bias_decay), scores.new_tensor(level_decay)
    precisions = [torch.where(unit[:, None] > 0, bias_decay, decay), tied, weak, weak]
    scales = [(c + p).rsqrt() for c, p in zip(_curvatures(groups, start.exp()), precisions, strict=True)]
    variables = [torch.zeros_like(scale, requires_grad=True) for scale in scales]
    optimiser = torch.optim.LBFGS(
        variables,
        max_iter=iterations,
        history_size=10,
        tolerance_grad=0.0,
        tolerance_change=1e-9,
        line_search_fn="strong_wolfe",
    )

    def current() -> list[Tensor]:
        return [v * scale for v, scale in zip(variables, scales, strict=True)]

    def loss() -> Tensor:
        optimiser.zero_grad()
        across, within, common, own = values = current()
        alpha, constant = (start + across + within).exp(), common + own
        total = torch.stack([(p * v.square()).sum() for p, v in zip(precisions, values, strict=True)]).sum() / 2
        for n, (rows, truth) in enumerate(groups):
            logits = F.linear(rows, alpha[:, n] - 1, constant[:, n])
            total = total + F.cross_entropy(logits, truth, reduction="sum")
        mean = total / samples
        mean.backward()
        return mean

    with torch.enable_grad():
        optimiser.step(loss)

    across, within, common, own = (value.detach() for value in current())
    alpha, constant = (start + across + within).exp(), common + own
    # c is ln π, less the normaliser of Dir(α), plus the shift by the floor.
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


def _curvatures(groups: list[tuple[Tensor, Tensor]], alpha: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Diagonal of the Hessian of the cross-entropy at the start, for u, v and the two parts of c.

    Scaled by it, directions of which the samples tell much and little are on one footing for L-BFGS.
    """
    weights, constants = [], []
    for rows, _ in groups:
        p = F.linear(rows, alpha[:, 0] - 1).softmax(-1)
        spread = (p * (1 - p)).t()
        weights.append(spread @ rows.square() * alpha[:, 0].square())
        constants.append(spread.sum(-1))
    weight, constant = torch.stack(weights, 1), torch.stack(constants, 1)
    return weight.sum(1, keepdim=True), weight, constant.sum(1, keepdim=True), constant
