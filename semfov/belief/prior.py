"""Priors of searches: change probabilities to another share of present targets than in the fit.

Where the `prior` of a search changes its probabilities, and where the share of the fit is kept:

    looks by          changed by                                  probabilities assume    `prior="fit"` stands for
    ----------------  ------------------------------------------  ----------------------  --------------------------
    a fovea           `Strategy.with_prior`, by the observer's    one half                `Presence.shares`, by class
                      `SemanticSearch.with_prior`
    a head            `HeadAgent.search`, by the same observer    one half                the same
    windows: a        `semfov.zoom.decision.decisions_of`         `PhotographEvidence     the same
    photograph                                                    .shares`, by class
    windows: a large  the same                                    one half                one half
    picture
    closer looks      `semfov.decision.PlaceVerifier` by its      as the looks of their search
                      places, which have the prior of their
                      search

The record keeps what was given (`prior`) and what is assumed (`assumed`), and changes its own decision
(`Record.probability_at`).
"""

import math
import sys
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal, Self, TypeAlias, TypeVar

import torch
from torch import Tensor

from semfov.errors import check
from semfov.io.schema import is_number

PriorLike: TypeAlias = float | Literal["fit"] | None
"""A share of the pictures that hold the target, `fit` for that of the searches of the fit, or None for one half."""

_Odds = TypeVar("_Odds", float, Tensor)


def with_prior(logit: _Odds, prior: float, fitted: float) -> _Odds:
    r"""Change log odds from the share of present targets in their fit to another share.

    .. math:: \operatorname{logit} P' = \operatorname{logit} P + \operatorname{logit} \pi
              - \operatorname{logit} \pi_{\mathrm{fit}}

    (Saerens, Latinne and Decaestecker, 2002, *Adjusting the outputs of a classifier to new a priori probabilities*.)

    Args:
        logit: log odds that the target is there.
        prior: share π of the searches whose target is there, above 0 and below 1.
        fitted: that share in the searches of the fit.

    Returns:
        Log odds, in the shape that was given.

    >>> round(with_prior(0.0, prior=0.2, fitted=0.5), 3)  # nothing is known but the share
    -1.386
    """
    return logit + _logit(prior) - _logit(fitted)


@dataclass(frozen=True)
class Prior:
    """The assumed share of searches with a present target, and the same share in the fit.

    Calls change a probability of presence, a float or a tensor (`with_prior`). The same shares change nothing.

    Attributes:
        share: share of the searches whose target is there, which changed probabilities assume.
        fitted: share in the searches of the fit.
        known: whether the share of the fit is known; if not, both are equal and nothing changes.

    >>> round(Prior(share=0.5, fitted=0.97)(0.99), 3)  # of a class that nearly all searches of the fit found
    0.754
    """

    share: float = 0.5
    fitted: float = 0.5
    known: bool = True

    @classmethod
    def of(cls, prior: PriorLike, fitted: float | None, usual: float | None = None) -> Self:
        """Make a prior from an assumed share and the share in the fit.

        Args:
            prior: share of the searches whose target is there; None for one half, `fit` for that of the fit. Models
                that do not know the share of their fit stay as they are.
            fitted: share that the probabilities of the model assume; None if it is not known.
            usual: share in the searches of the fit; None if they assume the same.

        Returns:
            Both shares.

        Raises:
            InputError: the share is no probability between 0 and 1, or that of the fit is not known.
        """
        if prior is not None and prior != "fit":
            check_share(prior)
            remedy = "use ActivePerception.recommended, or fit them to your detector (semfov fit)"
            expected = "None for models without the share of their fit"
            check(fitted is not None, "prior", expected, f"{prior}; {remedy}")
        if fitted is None:
            return cls(known=False)
        if prior == "fit":
            return cls(fitted if usual is None else usual, fitted)
        return cls(0.5 if prior is None else float(prior), fitted)

    @property
    def assumed(self) -> float | None:
        """Share of searches with a present target that the probabilities assume; None if unknown."""
        return self.share if self.known else None

    @property
    def changes_nothing(self) -> bool:
        """Whether the assumed share equals the share in the fit."""
        return self.share == self.fitted

    @property
    def inverse(self) -> "Prior":
        """The change back to the probabilities of the fit."""
        return Prior(self.fitted, self.share)

    def __call__(self, presence: _Odds) -> _Odds:
        if self.changes_nothing:
            return presence
        if isinstance(presence, Tensor):
            is_certain = (presence == 0) | (presence == 1)
            # A certainty stays; its log odds are infinite, and their gradient is no number.
            log_odds = presence.masked_fill(is_certain, 0.5).logit()
            return torch.where(is_certain, presence, with_prior(log_odds, self.share, self.fitted).sigmoid())
        return _changed(self, presence)

    def at_place(self, place: _Odds, presence: _Odds) -> _Odds:
        r"""Change the probability of a place in proportion to the probability of the picture.

        .. math:: P'(\text{place}) = P(\text{place}) \frac{P'}{P}

        Whether the target is at a place, given that the picture holds it, does not depend on how often pictures do.
        """
        if self.changes_nothing:
            return place
        if isinstance(place, Tensor):
            # No place is more probable than the picture, which two fits may contradict.
            picture = torch.maximum(torch.as_tensor(place), torch.as_tensor(presence))
            return place * (self(picture) / picture.clamp(min=torch.finfo(picture.dtype).tiny))
        picture = float(max(place, presence))
        return float(place * (self(picture) / max(picture, sys.float_info.min)))


@lru_cache(256)
def _changed(prior: Prior, presence: float) -> float:
    """Change a probability of presence. It is kept, because a search asks for the same one several times a look."""
    return float(prior(torch.tensor(presence, dtype=torch.float64)))


def check_share(prior: Any) -> None:
    """Raise `InputError` unless a share of searches is a number above 0 and below 1."""
    check(is_number(prior) and 0 < prior < 1, "prior", "a share above 0 and below 1", prior)


def _logit(share: float) -> float:
    """Compute the log odds of a share."""
    return math.log(share) - math.log1p(-share)
