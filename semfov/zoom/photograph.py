"""Evidence for photographs, which one look shows at more than half their size."""

from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.target_evidence import THRESHOLDS, Thresholds
from semfov.belief.verification import CLOSER_FEATURES, Verification
from semfov.io.schema import Array, Field, Maybe, Number, Object
from semfov.zoom.certainty import Certainty

_LEAST = 1e-4
_LARGEST = 1e3


class PhotographEvidence(nn.Module):
    r"""Whether a photograph holds a class, by a look at the whole and by closer looks at places that seem to hold it.

    After the look at the whole the log odds follow from the highest score s of the class in any hint, and from the
    share :math:`q_t` of photographs that hold the class:

    .. math:: \operatorname{logit} P(t) = a \operatorname{logit} s + b \operatorname{logit} q_t + c

    `verification` has the probabilities after a closer look, and `certainty` that of an object.

    Shapes: usual `(K,)`, :math:`\operatorname{logit} q`.
    """

    usual: Tensor

    def __init__(
        self, classes: int, *, thresholds: Thresholds | None = None, certainty: Certainty | None = None
    ) -> None:
        super().__init__()
        self.register_buffer("usual", torch.zeros(classes))
        self.whole = nn.Linear(2, 1)
        self.verification = Verification(thresholds=thresholds)
        self.certainty = certainty

    def presence(self, best: Tensor, target: Tensor) -> Tensor:
        """Log odds that the photograph holds classes 1..K, by their highest scores; shapes `(...)`."""
        facts = torch.stack([best.logit(_LEAST), self.usual[target - 1]], -1)
        odds: Tensor = self.whole(facts)[..., 0]
        return odds

    def record(self) -> dict[str, Any]:
        """Thresholds and certainty as JSON."""
        thresholds, certainty = self.verification.thresholds, self.certainty
        return {
            "thresholds": None if thresholds is None else vars(thresholds),
            "certainty": None if certainty is None else certainty.numbers,
        }

    @classmethod
    def of(cls, classes: int, record: Mapping[str, Any]) -> Self:
        """The module of a record, before its tensors are loaded."""
        thresholds, certainty = record["thresholds"], record["certainty"]
        return cls(
            classes,
            thresholds=None if thresholds is None else Thresholds(**thresholds),
            certainty=None if certainty is None else Certainty.of(certainty),
        )


def photograph_fields() -> dict[str, Field]:
    """Tensors of the evidence in a file, K classes."""
    shapes = {"usual": ("K",), "whole.weight": (1, 2), "whole.bias": (1,)}
    shapes |= {"verification.linear.weight": (2, CLOSER_FEATURES), "verification.linear.bias": (2,)}
    return {
        f"photograph.{name}": Field(shape, low=-_LARGEST, high=_LARGEST, optional=True)
        for name, shape in shapes.items()
    }


PHOTOGRAPH = Maybe(Object({"thresholds": THRESHOLDS, "certainty": Maybe(Array(Number(low=-1e6, high=1e6)))}))
"""Settings of the evidence in a file."""
