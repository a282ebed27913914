"""What a target draws and says of its input, and the runner that judges the outcomes."""

import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from semfov.errors import DataError, InputError


class Draw:
    """Random choices for one input; `rng` draws arrays, because hypothesis would draw them number by number."""

    def __init__(self, data: st.DataObject) -> None:
        self.data = data
        self.rng = np.random.default_rng(self.integer(0, 2**32 - 1, "seed"))

    def choose(self, options: Iterable[Any], label: str) -> Any:
        """One of the options."""
        return self.data.draw(st.sampled_from(list(options)), label=label)

    def integer(self, low: int, high: int, label: str) -> int:
        """Return a whole number of a range, both ends included."""
        return self.data.draw(st.integers(low, high), label=label)

    def flag(self, label: str) -> bool:
        """Yes or no."""
        return self.data.draw(st.booleans(), label=label)


@dataclass(frozen=True)
class Case:
    """An input and what is right for it.

    Attributes:
        call: passes the input to semfov.
        check: raises an `AssertionError` if the result is wrong; may return `missing`.
        may: whether the input may be refused.
        must: whether it must be refused; None: if it may.
        names: the arguments that a refusal may name; None: any.
    """

    call: Callable[[], Any]
    check: Callable[[Any], str | None]
    may: bool = False
    must: bool | None = None
    names: Collection[str] | None = None

    def judge(self) -> str:
        """Name the kind of the outcome: `result`, `missing`, or the error that semfov raised on purpose."""
        try:
            result = self.call()
        except (DataError, InputError) as error:
            message = str(error)
            assert 10 < len(message) < 1000, message
            assert "\n" not in message, message
            assert self.may, message
            assert self.names is None or message.partition(":")[0] in self.names, message
            return DataError.__name__ if isinstance(error, DataError) else InputError.__name__
        assert not (self.may if self.must is None else self.must), f"let through: {result}"
        return self.check(result) or "result"


Target = Callable[[Draw, Path], Case]
"""Makes a case from random choices and an empty folder."""


def run(target: Target, cases: int, number: int = 0) -> Counter[str]:
    """Run a target, and count its results and errors.

    Args:
        target: the target; a finding is an exception, and the smallest such input is reported.
        cases: number of inputs.
        number: random seed of the inputs.

    Returns:
        The counts by kind of outcome.
    """
    outcomes: Counter[str] = Counter()

    @seed(number)
    @settings(
        max_examples=cases,
        deadline=None,
        database=None,
        derandomize=False,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def case(data: st.DataObject) -> None:
        with tempfile.TemporaryDirectory() as folder:
            outcomes[target(Draw(data), Path(folder)).judge()] += 1

    case()
    return outcomes


def changed(content: bytes, damage: str, rng: np.random.Generator) -> bytes:
    """Damage the contents of a file (`cut`, `longer`, `text`, `bit` or `bytes`); they are always other than before."""
    if damage == "cut":
        return content[: int(rng.integers(0, len(content)))]
    if damage == "longer":
        return content + rng.bytes(int(rng.integers(1, 50)))
    if damage == "text":
        return b"<html>404 Not Found</html>"
    if damage in ("bit", "bytes"):
        values = np.frombuffer(content, np.uint8).copy()
        places = rng.integers(0, len(values), 1 if damage == "bit" else int(rng.integers(2, 9)))
        bits = rng.integers(1, 256, len(places)) if damage == "bytes" else 1 << rng.integers(8)
        values[places] ^= np.asarray(bits, np.uint8)
        return values.tobytes()
    return content
