"""Closer looks at the candidates of searches, and the fit of the verification to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.observers import Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.belief.verification import FEATURES, Verification
from semfov.decision import CandidateCells, cell_of
from semfov.errors import DataError
from semfov.fit.closer_looks import Photograph, search
from semfov.fit.verification_decisions import LEVELS, Verified, choose_confirm, verify
from semfov.fit.verification_settings import FitVerificationConfig
from semfov.runs.progress import track

AFTER = (1, 3, 5, 8, 12)
"""Numbers of looks after which candidates are examined for the fit."""

SHIPPED = ("yolox-nano", "yolov3-tiny")
"""Shipped models whose mean is the centre of the prior for other detectors."""

STRENGTH = 10.0
"""Strength of this prior, chosen on photographs that no result is reported on (docs/decisions/closer_looks.md)."""

_EACH = 3  # candidates examined after some looks
_LEAST = 0.03  # least probability of their cells
_RIDGE = 1e-4


@dataclass(frozen=True)
class Examined:
    """Closer looks at places that seemed to hold a target.

    Attributes:
        features: `(N, 7)`, features of the closer looks.
        right: `(N,)` boolean, whether the target is at the place.
        present: `(N,)` boolean, whether the photograph holds it.
        fold: `(N,)`, part of the photographs.
    """

    features: Tensor
    right: Tensor
    present: Tensor
    fold: Tensor


@dataclass(frozen=True)
class FittedVerification:
    """A fitted model and its evaluation in folds.

    Attributes:
        model: the model, fitted to all closer looks, with thresholds.
        folds: for each fold, the model fitted to the others.
        examined: the closer looks.
        searches: the searches, each with the model of its fold.
    """

    model: Verification
    folds: list[Verification]
    examined: Examined
    searches: list[Verified]


def fit_and_verify(
    seen: Sequence[Photograph],
    evidence: TargetEvidence,
    config: FitVerificationConfig,
    prior: Verification | None = None,
    surest: float = LEVELS[-1],
) -> FittedVerification:
    """Fit the model to closer looks at photographs, repeat the searches in folds, and choose the threshold `confirm`.

    Args:
        seen: the photographs.
        evidence: the target evidence.
        config: the settings.
        prior: model towards which to fit (`fit`).
        surest: upper limit of the threshold.

    Returns:
        The model with its evaluation.
    """
    with torch.inference_mode():
        examined = examine(seen, evidence, config)
    folds = [fit(examined, examined.fold != fold, prior) for fold in range(config.folds)]
    model = fit(examined, examined.fold >= 0, prior)
    with torch.inference_mode():
        searches = list(verify(seen, folds, evidence, config))
    confirm = choose_confirm(searches, config.false_alarms, surest)
    model.thresholds = Thresholds(confirm, config.give_up, config.place)
    return FittedVerification(model, folds, examined, searches)


def examine(seen: Sequence[Photograph], evidence: TargetEvidence, config: FitVerificationConfig) -> Examined:
    """Look closely at the candidates after some looks of every search.

    Args:
        seen: the photographs.
        evidence: the target evidence.
        config: the settings.

    Returns:
        The closer looks.

    Raises:
        DataError: there is no candidate, or none of them is right, or none wrong.
    """
    rows: list[tuple[Tensor, bool, bool, int]] = []
    observer = Target(evidence)
    for photograph in track(seen, "looking", "photograph"):
        for sought in (each for each in photograph.sought if not each.spare):
            steps = []
            for step in search(photograph, sought, observer, config.looks):
                steps.append(step)
                if len(steps) not in AFTER:
                    continue
                candidates = CandidateCells(photograph.grid, sought.target)
                for each in steps:
                    candidates.see(each)
                for _ in range(_EACH):
                    candidate = candidates.due(_LEAST, last=True)
                    if candidate is None:
                        break
                    features, box = candidates.examine(candidate, photograph.close_up)
                    right = bool(sought.goal[cell_of(box, photograph.grid)])
                    rows.append((features, right, sought.present, photograph.number % config.folds))
        photograph.close()
    if len({right for _, right, _, _ in rows}) < 2:
        raise DataError("data: expected places that hold the target and places that do not, got only one kind")
    columns = list(zip(*rows, strict=True))
    return Examined(torch.stack(columns[0]), *(torch.tensor(column) for column in columns[1:]))


def fit(examined: Examined, chosen: Tensor, prior: Verification | None = None) -> Verification:
    r"""Fit both logistic regressions by penalised maximum likelihood.

    .. math:: \min_{w, b} \; \frac1N \sum_i \mathrm{BCE}(w^\top \phi_i + b, y_i) + \lambda |w'|^2, \qquad
              \lambda = 10^{-4}

    where w' are the weights of the features scaled to zero mean and unit variance. With a prior the fit keeps close to
    a model with parameters :math:`w_0, b_0`, the closer the fewer the closer looks:

    .. math:: \min_{w, b} \; \frac1N \sum_i \mathrm{BCE}(w^\top \phi_i + b, y_i)
              + \frac{\kappa}{N} \left( |w' - w'_0|^2 + (b' - b'_0)^2 \right), \qquad \kappa = 10

    This is the maximum a posteriori estimate for normal distributions around :math:`w'_0` and :math:`b'_0`.

    Args:
        examined: the closer looks.
        chosen: `(N,)` boolean, the closer looks to fit to.
        prior: model at the centre of the prior; None fits without.

    Returns:
        The model, without thresholds.

    Raises:
        DataError: fewer than two closer looks are chosen.
    """
    phi = examined.features[chosen].double()
    if len(phi) < 2:
        raise DataError(f"data: expected closer looks in all folds but one, got {len(phi)}; give more photographs")
    goal = torch.stack([examined.right, examined.present], -1)[chosen].double()
    mean, scale = phi.mean(0), phi.std(0).clamp(min=1e-6)
    centre, level = torch.zeros(2, FEATURES, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)
    weights, biases = _RIDGE, 0.0
    if prior is not None:
        given = prior.linear.weight.detach().double()
        centre, level = given * scale, prior.linear.bias.detach().double() + given @ mean
        weights = biases = STRENGTH / len(phi)
    weight, bias = centre.clone().requires_grad_(True), level.clone().requires_grad_(True)
    optimiser = torch.optim.LBFGS([weight, bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        odds = (phi - mean) / scale @ weight.mT + bias
        value = F.binary_cross_entropy_with_logits(odds, goal, reduction="none").mean(0).sum()
        value = value + weights * (weight - centre).square().sum() + biases * (bias - level).square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    model = Verification()
    with torch.no_grad():
        model.linear.weight.copy_(weight / scale)
        model.linear.bias.copy_(bias - (weight / scale) @ mean)
    return model.eval().requires_grad_(False)


def shipped_mean() -> Verification:
    """Return the mean of two shipped models (`SHIPPED`), without thresholds: the centre of the prior."""
    known = [Verification.from_pretrained(name).linear for name in SHIPPED]
    model = Verification()
    with torch.no_grad():
        model.linear.weight.copy_(torch.stack([each.weight for each in known]).mean(0))
        model.linear.bias.copy_(torch.stack([each.bias for each in known]).mean(0))
    return model.eval().requires_grad_(False)
