"""Whether a picture holds a class, from the belief about its cells."""

from copy import deepcopy

import torch
from torch import Tensor, nn

from semfov.errors import check, check_finite, check_tensor
from semfov.io.schema import Field
from semfov.observation.thresholds import DecidingModule, Thresholds
from semfov.precision import exact_product

SHARES = Field(("K",), low=1e-6, high=1 - 1e-6, optional=True)
"""Schema of the shares, by class, of the searches of a fit whose target was there, in the file of a model."""

PRESENCE = {
    "presence.offset": Field((), low=-1e3, high=1e3, optional=True),
    "presence.slopes": Field((2,), low=-1e3, high=1e3, optional=True),
    "presence.shares": SHARES,
    "presence.place": Field((2,), low=-1e3, high=1e3, optional=True),
    "presence.centre": Field((2,), low=-1e3, high=1e3, optional=True),
}
"""Schema of a `Presence` in the file of a model."""

EVEN = 0.5
"""Share of the searches whose target is there that a `Presence` assumes."""

FAINT_SCORE = 3e-4
"""Score ε below which a highest score hardly counts (`log_evidence`); no threshold, as `faint` of a detector is."""

_SURE = 1e-6  # probabilities nearer to 0 or 1 count as this far from them


def log_odds_of_cells(probability: Tensor) -> Tensor:
    """Compute the log odds of probabilities of cells, which stay finite where a cell is certain.

    Args:
        probability: `(...)`.

    Returns:
        `(...)`.
    """
    return probability.clamp(_SURE, 1 - _SURE).logit()


def log_evidence(score: Tensor) -> Tensor:
    r"""Compute :math:`\ln (1 + s / \varepsilon)` of scores s, which is 0 where nothing was seen (`FAINT_SCORE`).

    Args:
        score: `(...)`, from 0 to 1.

    Returns:
        `(...)`, at least 0.
    """
    return (score / FAINT_SCORE).log1p()


def presence_facts(probability: Tensor, evidence: Tensor) -> Tensor:
    """Collect the inputs of a `Presence` from a belief about a class.

    Args:
        probability: `(..., X·Y)`, of the class in each cell.
        evidence: `(...)`, `log_evidence` of the highest score of the class in any look.

    Returns:
        `(..., 2)`.
    """
    return torch.stack([log_odds_of_cells(probability.amax(-1)), evidence], -1)


def _check_numbers(values: Tensor, name: str, shape: tuple[int, ...]) -> None:
    """Raise `InputError` unless this is a tensor of finite floating-point numbers of a shape."""
    check_tensor(values, name)
    check(values.is_floating_point(), name, "a floating-point tensor", values.dtype)
    check(tuple(values.shape) == shape, name, f"shape {shape}", tuple(values.shape))
    check_finite(values, name)


class Presence(DecidingModule):
    r"""Probability that a picture holds a class, from the most probable cell, and from the highest score of any look.

    .. math:: \operatorname{logit} P(t) = a + b \operatorname{logit} \max_x P(t \in x)
              + c \max_{i, l} \ln \bigl(1 + s_{lt}^{(i)} / \varepsilon\bigr)

    A cell takes the closest look alone, and knows of detections only. The last term, over the candidates l of each look
    i, those that are too faint for a detection among them, keeps the best of what was seen (`log_evidence`). It assumes
    that the target is in half of the pictures (`EVEN`), whatever the class. Two further numbers make the probability of
    a cell true (`of_cells`): two where all cells under a detection have its weight, and two where the cell of its
    centre has all of it.

    .. math:: \operatorname{logit} P'(t \in x) = a_x + b_x \operatorname{logit} P(t \in x)

    Args:
        offset: a, `()`.
        slopes: b and c, `(2,)`.
        shares: `(K,)`, by class, shares of the searches of the fit whose target was there.
        thresholds: thresholds at which searches decide; None if none were chosen.
        place: :math:`a_x` and :math:`b_x`, `(2,)`, where all cells under a detection have its weight; None leaves the
            probabilities of cells as they are.
        centre: likewise where the cell of its centre has all of it.

    Raises:
        InputError: a shape does not fit, or a number is not finite.

    >>> presence = Presence(torch.tensor(0.0), torch.tensor([0.5, 0.0]), torch.full((2,), 0.5))
    >>> facts = presence_facts(torch.tensor([[0.9, 0.1]]), log_evidence(torch.tensor([0.8])))
    >>> presence(facts).detach().sigmoid()  # less sure than the cell
    tensor([0.7500])
    """

    offset: Tensor
    slopes: Tensor
    place: Tensor
    centre: Tensor | None
    shares: Tensor

    def __init__(
        self,
        offset: Tensor,
        slopes: Tensor,
        shares: Tensor,
        thresholds: Thresholds | None = None,
        *,
        place: Tensor | None = None,
        centre: Tensor | None = None,
    ) -> None:
        super().__init__()
        check_tensor(shares, "shares")
        if place is None:
            place = torch.tensor([0.0, 1.0]).to(shares)  # P' = P
        _check_numbers(offset, "offset", ())
        _check_numbers(slopes, "slopes", (2,))
        _check_numbers(place, "place", (2,))
        if centre is not None:
            _check_numbers(centre, "centre", (2,))
        _check_numbers(shares, "shares", (shares.numel(),))
        are_shares = bool(((shares > 0) & (shares < 1)).all())
        check(are_shares, "shares", "numbers above 0 and below 1", shares.tolist())
        check(thresholds is None or isinstance(thresholds, Thresholds), "thresholds", "Thresholds or None", thresholds)
        self.offset = nn.Parameter(offset.detach().clone())
        self.slopes = nn.Parameter(slopes.detach().clone())
        self.place = nn.Parameter(place.detach().clone())
        # Registered also where there is none.
        self.register_parameter("centre", None if centre is None else nn.Parameter(centre.detach().clone()))
        self.register_buffer("shares", shares.detach().clone())
        self.thresholds = thresholds

    def forward(self, facts: Tensor) -> Tensor:
        """Compute the log odds that the picture holds the class.

        Args:
            facts: `(..., 2)` (`presence_facts`).

        Returns:
            `(...)`, differentiable in the facts and the three numbers.
        """
        return self.offset.to(facts) + exact_product(facts, self.slopes.to(facts))

    def detach(self) -> "Presence":
        """Copy the module with constant parameters, through which no gradient flows.

        Returns:
            The copy.
        """
        return deepcopy(self).requires_grad_(False)

    def of_cells(self, probability: Tensor, footprint: str) -> Tensor:
        """Calibrate the probabilities of cells.

        Args:
            probability: `(...)`, of the class in each cell.
            footprint: rule for the weight of a detection in each cell (`Grid.footprint`): `overlap` or `box_centre`;
                the numbers of others are not known.

        Returns:
            `(...)`; as they are where the numbers are not known.
        """
        numbers = {"overlap": self.place, "box_centre": self.centre}.get(footprint)
        if numbers is None:
            return probability
        # In float64, so that what is rounded does not depend on the other episodes of a batch.
        offset, slope = numbers.double()
        log_odds = offset + slope * log_odds_of_cells(probability.double())
        return log_odds.sigmoid().to(probability)


def presence_of(tensors: dict[str, Tensor], thresholds: Thresholds | None) -> Presence | None:
    """Make the `Presence` from the tensors of a file; None if the file has none.

    Args:
        tensors: those of the file, by name (`PRESENCE`).
        thresholds: the thresholds of the file.

    Returns:
        The presence; None where the file has none.

    Raises:
        InputError: it has only some of them.
    """
    needed = ("presence.offset", "presence.slopes", "presence.shares", "presence.place")
    found = [name for name in PRESENCE if name in tensors]
    if not found:
        return None
    check(all(name in found for name in needed), "presence", f"all of {', '.join(needed)}", ", ".join(found))
    offset, slopes, shares, place = (tensors[name] for name in needed)
    return Presence(offset, slopes, shares, thresholds, place=place, centre=tensors.get("presence.centre"))
