"""Thresholds on probabilities at which a search decides, stored in a model."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from semfov.io.schema import Maybe, Number, Object
from semfov.io.state import StatedModule


@dataclass(frozen=True)
class Thresholds:
    """Thresholds on probabilities at which a search decides.

    Attributes:
        confirm: least probability of the picture, or of a place after a closer look, for `found`.
        stop_below: probability of a cell or a place below which it is not worth a look.
        place: least probability of the place of a target that is found, or of one that is worth a closer look.

    >>> Thresholds(confirm=0.7, stop_below=0.1).changed(confirm=0.9)
    Thresholds(confirm=0.9, stop_below=0.1, place=0.0)
    """

    confirm: float
    stop_below: float
    place: float = 0.0

    def changed(
        self, confirm: float | None = None, stop_below: float | None = None, place: float | None = None
    ) -> "Thresholds":
        """Copy with other values.

        Args:
            confirm: another value, or None to keep the present one.
            stop_below: likewise.
            place: likewise.

        Returns:
            The copy.
        """
        values = {"confirm": confirm, "stop_below": stop_below, "place": place}
        return replace(self, **{name: value for name, value in values.items() if value is not None})


THRESHOLDS = Maybe(
    Object(dict.fromkeys(("confirm", "give_up", "place"), Number(0, 1)), required=("confirm", "give_up", "place"))
)
"""Schema of thresholds in the file of a model, in which `stop_below` is called `give_up`."""


def thresholds_record(thresholds: Thresholds | None) -> dict[str, float] | None:
    """Write thresholds as values of a file (`THRESHOLDS`).

    Args:
        thresholds: the thresholds; None for none.

    Returns:
        The values by name.

    >>> thresholds_record(Thresholds(0.7, stop_below=0.1))
    {'confirm': 0.7, 'give_up': 0.1, 'place': 0.0}
    """
    if thresholds is None:
        return None
    return {"confirm": thresholds.confirm, "give_up": thresholds.stop_below, "place": thresholds.place}


def thresholds_of(record: Mapping[str, float] | None) -> Thresholds | None:
    """Read thresholds from values of a file.

    Args:
        record: the values by name, as `thresholds_record` writes them.

    Returns:
        The thresholds; None for none.
    """
    if record is None:
        return None
    return Thresholds(record["confirm"], record["give_up"], record["place"])


class DecidingModule(StatedModule):
    """Base of modules whose state includes thresholds at which searches decide.

    Attributes:
        thresholds: the thresholds; None if none were chosen.
    """

    thresholds: Thresholds | None = None

    def _fitted_values(self) -> dict[str, object]:
        return {"thresholds": thresholds_record(self.thresholds)}

    def _load_fitted_values(self, values: Mapping[str, Any]) -> None:
        self.thresholds = thresholds_of(values["thresholds"])
