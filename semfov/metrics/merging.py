"""Measures as metrics of torchmetrics, which merge over batches and processes (`pip install "semfov[metrics]"`)."""

from typing import Any

import torch
from torch import Tensor

from semfov.errors import InputError, check, check_shape
from semfov.metrics.calibration import BinarySums
from semfov.metrics.episodes import area_under_roc
from semfov.metrics.labels import as_numbers, as_outcomes

try:
    from torchmetrics import Metric
except ImportError:
    raise InputError("these metrics need torchmetrics: pip install semfov[metrics]") from None


class AreaUnderRoc(Metric):
    """Area under the receiver operating characteristic of all cases so far (`semfov.metrics.episodes.area_under_roc`).

    It keeps the scores, as the area needs all of them.

    Args:
        options: of `torchmetrics.Metric`, such as `sync_on_compute`.

    >>> area = AreaUnderRoc()
    >>> area.update(torch.tensor([0.9, 0.4]), torch.tensor([True, True]))
    >>> area.update(torch.tensor([0.4, 0.1]), torch.tensor([False, False]))
    >>> area.compute()
    tensor(0.8750)
    """

    is_differentiable = False
    higher_is_better = True
    full_state_update = False
    score: list[Tensor]
    present: list[Tensor]

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state("score", default=[], dist_reduce_fx="cat")
        self.add_state("present", default=[], dist_reduce_fx="cat")

    def update(self, score: Tensor, present: Tensor) -> None:
        """Add cases.

        Args:
            score: `(M,)`, higher where the target is more likely.
            present: `(M,)`, whether it is there: booleans, or 0 and 1.

        Raises:
            InputError: these are other values, or the shapes differ.
        """
        scores = as_numbers(score, "score").detach().double()
        is_present = as_outcomes(present, "present")
        check(scores.ndim == 1, "score", "scores of shape (M,)", (*scores.shape,))
        check_shape(is_present, "present", len(scores))
        self.score.append(scores)
        self.present.append(is_present.to(scores.device))

    def sync(self, *arguments: Any, **options: Any) -> None:
        """Join the cases of all processes, of which each takes part, even without a case.

        Args:
            arguments: as of `torchmetrics.Metric.sync`.
            options: likewise.
        """
        if isinstance(self.score, list) and not self.score:
            self.score.append(torch.zeros(0, dtype=torch.float64, device=self.device))
            self.present.append(torch.zeros(0, dtype=torch.bool, device=self.device))
        super().sync(*arguments, **options)

    def compute(self) -> Tensor:
        """Compute the area over all cases; both kinds are needed."""
        # After a synchronisation the cases of all updates are one tensor already.
        states = (self.score, self.present)
        cases = [state if isinstance(state, Tensor) else torch.cat(state) for state in states if len(state)]
        check(bool(cases) and len(cases[0]) > 0, "score", "cases of both kinds", "none; call update first")
        return torch.tensor(area_under_roc(*cases))


class Reliability(Metric):
    """Negative log likelihood, Brier score and calibration error of all predictions so far (`BinarySums`).

    It keeps sums, so that its size does not grow.

    Args:
        options: of `torchmetrics.Metric`, such as `sync_on_compute`.

    >>> reliability = Reliability()
    >>> reliability.update(torch.tensor([0.9, 0.2]), torch.tensor([True, False]))
    >>> {name: round(float(value), 3) for name, value in reliability.compute().items()}
    {'count': 2.0, 'nll': 0.164, 'brier': 0.025, 'ece': 0.15}
    """

    is_differentiable = False
    higher_is_better = False
    full_state_update = False
    bins: Tensor
    sums: Tensor

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.add_state(
            "bins", default=torch.zeros(3, len(BinarySums.EDGES) + 1, dtype=torch.float64), dist_reduce_fx="sum"
        )
        self.add_state("sums", default=torch.zeros(2, dtype=torch.float64), dist_reduce_fx="sum")

    def update(self, probability: Tensor, outcome: Tensor) -> None:
        """Add predictions.

        Args:
            probability: `(M,)`.
            outcome: `(M,)`, whether it came true: booleans, or 0 and 1.
        """
        added = BinarySums.of(probability, outcome)
        self.bins += added.bins.to(self.bins.device)
        self.sums += torch.tensor([added.surprisal, added.square], dtype=torch.float64, device=self.sums.device)

    def compute(self) -> dict[str, Tensor]:
        """Compute number of predictions, mean negative log likelihood in nats, Brier score and calibration error."""
        sums = BinarySums(self.bins.cpu(), *self.sums.tolist())
        return {name: torch.tensor(float(getattr(sums, name))) for name in ("count", "nll", "brier", "ece")}
