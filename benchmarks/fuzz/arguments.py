"""Fuzz arguments of the agent and settings, inside and outside their ranges."""

import dataclasses
import math
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import ActivePerception, Eye, Foveation, Scanpath, observers, policies
from semfov.detection import Candidates, Detector
from semfov.runs import config as settings
from semfov.runs.settings import Range

NUMBERS: list[Any] = [
    -(10**12), -2, -1, 0, 1, 2, 3, 7, 11, 12, 50, 10_000, 10_001, 2**31, 2**63 - 1, 2**63, 10**30,
    -0.5, 0.0, 0.25, 0.999, 1.0, 1.5, 1e-300, 1e300, math.nan, math.inf, -math.inf, True, False, [], "3", {},
]  # fmt: skip
PICTURES = ("ordinary", "ordinary", "ordinary", "bytes", "255 times", "negative", "NaN", "infinite", "float64", "half")


class Plain(Detector):
    """A detector that sees one cup in every view."""

    def __init__(self) -> None:
        super().__init__("plain", ("cup", "cat"), (32, 32))

    def propose(self, canvas: Tensor) -> Candidates:
        """Return the same candidates for every canvas."""
        box = canvas.new_tensor([[4.0, 4, 20, 20]]).expand(len(canvas), 1, 4)
        return Candidates(box, canvas.new_tensor([[0.9, 0.1]]).expand(len(canvas), 1, 2), None)


def agent_arguments(data: st.DataObject) -> str:
    """`search` and `explore`: a scanpath on the grid if all values are valid, else `InputError` that names one."""
    rng = draw_rng(data)
    kind = choose(data, PICTURES, "image")
    image = picture(kind, rng)
    arguments: dict[str, Any] = {}
    wrong = set() if kind in ("ordinary", "bytes", "float64", "half") else {"picture"}
    ranges = {"shifts": (0, 10_000), "seed": (0, 2**63 - 1), "start": (0, 11)}
    for name, (low, high) in ranges.items():
        if not data.draw(st.booleans(), label=f"give {name}"):
            continue
        value = choose(data, NUMBERS, name)
        if name in ("start", "shifts") and value is None:
            continue
        arguments[name] = value
        if not (isinstance(value, int) and not isinstance(value, bool) and low <= value <= high):
            wrong.add(name)
    observer = observers.Semantic(3)
    eye = Eye(Foveation(10.0), Plain(), reference=64.0)
    agent = ActivePerception(eye, (observer, policies.NonPredictive()), (observer, policies.Random()), grid=(4, 3))
    seek = data.draw(st.booleans(), label="search")
    result = attempt(lambda: agent.search(image, "cup", **arguments) if seek else agent.explore(image, **arguments))
    if failed(result):
        name = str(result).partition(":")[0]
        assert name in wrong, result
        return outcome(result)
    assert not wrong, f"{wrong} let through: {arguments}"
    assert isinstance(result, Scanpath)
    assert 1 <= len(result.cells) <= min(arguments.get("shifts", 30 if seek else 20), 11) + 1
    assert bool(((result.cells >= 0) & (result.cells < 12)).all())
    return "result"


def picture(kind: str, rng: np.random.Generator) -> Tensor:
    """A small image, or a tensor that is not a valid image."""
    image = torch.from_numpy(rng.random((3, int(rng.integers(8, 40)), int(rng.integers(8, 40))), dtype=np.float32))
    place = tuple(int(rng.integers(size)) for size in image.shape)
    if kind in ("NaN", "infinite"):
        image[place] = math.nan if kind == "NaN" else math.inf
        return image
    changed = {
        "bytes": lambda: (image * 255).byte(),
        "255 times": lambda: image * 255,
        "negative": lambda: image - 0.5,
        "float64": lambda: image.double(),
        "half": lambda: image.half(),
    }
    return changed[kind]() if kind in changed else image


def settings_values(data: st.DataObject) -> str:
    """Settings of the commands: accepted if a number is in the range of its type, else refused by name."""
    kinds = [kind for kind in vars(settings).values() if dataclasses.is_dataclass(kind) and isinstance(kind, type)]
    ranged = [(kind, *field) for kind in kinds for field in fields_of(kind)]
    kind, name, base, allowed, optional = choose(data, ranged, "setting")
    edges = [e for bound in (allowed.low, allowed.high, allowed.above) if math.isfinite(bound)
             for e in (bound - 1, bound, bound + 1, bound + 0.5)]  # fmt: skip
    value = choose(data, [*NUMBERS, *edges, *([None] if optional else [])], "value")
    values = {"policy": "random", name: value} if kind is settings.PolicyConfig else {name: value}
    result = attempt(lambda: kind(**values))
    number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    fits = number and (base is float or isinstance(value, int))
    fits = fits and max(allowed.low, -math.inf) <= value <= allowed.high and value > allowed.above
    word = isinstance(value, dict) or (isinstance(value, str) and optional)
    if failed(result):
        assert not fits, result
        assert str(result).startswith(f"{name}: expected "), result
        return outcome(result)
    # Words and mappings are checked only on the command line.
    assert fits or (value is None and optional) or word, f"{kind.__name__}.{name}={value!r}"
    return "result"


def fields_of(kind: type[Any]) -> list[tuple[str, type, Range, bool]]:
    """Name, type and range of every number among the settings, and whether it may be None."""
    ranges = []
    for name, hint in get_type_hints(kind, include_extras=True).items():
        for option in (hint, *get_args(hint)):
            if get_origin(option) is Annotated and isinstance(get_args(option)[1], Range):
                base, allowed = get_args(option)[:2]
                ranges.append((name, base, allowed, option is not hint))
    return ranges
