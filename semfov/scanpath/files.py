"""Files of scanpaths: tensors, with JSON values that describe them."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike
from typing import Any, get_args

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.decision import CloserLook, Decision, Outcome
from semfov.detection.detections import Detections
from semfov.detection.placement import Placement
from semfov.episode import STAGES
from semfov.errors import DataError, InputError, check
from semfov.io.schema import Anything, Array, Field, Flag, Json, Maybe, Number, Object, Pair, Schema, Text
from semfov.io.storage import read, write
from semfov.scanpath.stimulus import LONGEST, Stimulus
from semfov.version import __version__

KIND = "scanpath"
_ENDINGS = ("box", "decision", "price", "shifts", "cells")
_WHOLE, _POSITIVE = Number(low=0, whole=True), Number(above=0)


def _pair(of: Json) -> Pair:
    return Pair((of, of))


_PLACEMENT = {"size": _pair(_POSITIVE), "scale": _pair(_POSITIVE), "offset": _pair(_WHOLE)}
_SENSOR = {
    "sigma": _POSITIVE,
    "levels": Number(low=0, high=16, whole=True),
    "growth": _POSITIVE,
    "convention": Text(("kornia", "opencv")),
    "reference": _POSITIVE,
}
_SETTINGS = Object(
    {
        # Other settings, of a user's own sensor, are kept without a check.
        "sensor": Object(_SENSOR, Anything(), ("reference",)),
        "detector": Object({"name": Text()}, Anything(), ("name",)),
    },
    Anything(),
    ("sensor", "detector"),
)
_CHANCE = Number(0, 1)
_DECISION = {
    "outcome": Text(get_args(Outcome)),
    "probability": Number(),
    "cell": Maybe(_WHOLE),
    "place": Maybe(_CHANCE),
}
_CLOSER = {"fixation": _WHOLE, "target": _WHOLE, "cell": _WHOLE, "place": _CHANCE, "presence": _CHANCE}

SCHEMA = Schema(
    {
        "cells": Field(("n",), dtype=torch.int64, low=0),
        "fixations": Field(("n", 2), mixed=True),
        "boxes": Field(("M", 4), mixed=True),
        "scores": Field(("M", "C"), mixed=True),
        "mask": Field(("M",), dtype=torch.bool),
        "probabilities": Field(("n", "cells", "C"), mixed=True, low=0, high=1 + 1e-3),
        "values": Field(("n", "cells"), mixed=True, finite=False),
        "posterior": Field(("n", "cells"), mixed=True, low=0, high=1 + 1e-3, optional=True),
        "presence": Field(("n",), mixed=True, low=0, high=1 + 1e-3, optional=True),
        "box": Field((4,), mixed=True, optional=True),
        "closer_boxes": Field(("Q", 4), mixed=True, optional=True),
        "photograph": Field((3, "h", "w"), dtype=torch.uint8, optional=True),
        "canvas": Field((3, "H", "W"), dtype=torch.uint8, optional=True),
    },
    {
        "version": Text(),
        "classes": Array(Text(), "C", least=2),
        "grid": Pair((Number(low=1, high=10_000, whole=True), Number(low=1, high=10_000, whole=True))),
        "size": _pair(_POSITIVE),
        "lengths": Array(_WHOLE, "n", least=1),
        "target": Maybe(_WHOLE),
        "found": Flag(),
        # Files of earlier versions have neither `place` nor `closer`.
        "decision": Maybe(Object(_DECISION, None, ("outcome", "probability", "cell"))),
        "closer": Maybe(Array(Object(_CLOSER, None, tuple(_CLOSER)))),
        "ending": Maybe(Text(_ENDINGS)),
        "seconds": Array(Object(dict.fromkeys(STAGES, Number(low=0)), Number(low=0))),
        "placement": Maybe(Object(_PLACEMENT, None, tuple(_PLACEMENT))),
        "settings": Maybe(_SETTINGS),
    },
)


def write_fields(path: str | PathLike[str], fields: Mapping[str, Any]) -> None:
    """Write the fields of a scanpath to a file."""
    grid, decision, stimulus = fields["grid"], fields["decision"], fields["stimulus"]
    looks: tuple[Detections, ...] = fields["detections"]
    tensors = {name: fields[name] for name in ("cells", "fixations", "probabilities", "values")}
    tensors |= {name: fields[name] for name in ("posterior", "presence") if fields[name] is not None}
    # The detections of all looks in a row, without padding; `lengths` separates them again.
    tensors |= {name: torch.cat([getattr(look, name)[0] for look in looks]) for name in ("boxes", "scores", "mask")}
    size = grid.size.tolist() if isinstance(grid.size, Tensor) else list(grid.size)
    record: dict[str, Any] = {
        "kind": KIND,
        "version": __version__,
        "classes": list(fields["classes"]),
        "grid": [grid.columns, grid.rows],
        "size": size,
        "lengths": [look.mask.shape[-1] for look in looks],
        **{name: fields[name] for name in ("target", "found", "ending")},
        "decision": None,
        "closer": [{name: getattr(look, name) for name in _CLOSER} for look in fields["closer"]],
        "seconds": [dict(each) for each in fields["seconds"]],
        "placement": None,
        "settings": None,
    }
    if decision is not None:
        record["decision"] = {name: getattr(decision, name) for name in _DECISION}
        if decision.box is not None:
            tensors["box"] = decision.box
    if fields["closer"]:
        tensors["closer_boxes"] = torch.stack([look.box for look in fields["closer"]])
    if stimulus is not None:
        tensors |= {name: getattr(stimulus, name) for name in ("photograph", "canvas")}
        record["placement"] = {name: list(getattr(stimulus.placement, name)) for name in _PLACEMENT}
        record["settings"] = dict(stimulus.settings)
    write(path, tensors, record)


def read_fields(path: str | PathLike[str]) -> dict[str, Any]:
    """Read the fields of a scanpath that `write_fields` wrote.

    Returns:
        The fields by name.

    Raises:
        DataError: the file is missing or damaged, or holds no scanpath.
    """
    tensors, record = read(path, KIND)
    record.pop("kind")
    try:
        unknown = record.keys() - SCHEMA.record.keys()
        check(not unknown, "record", f"no other values than {', '.join(SCHEMA.record)}", sorted(unknown))
        SCHEMA.check(tensors, record)
        return _restored(tensors, record)
    except InputError as error:
        raise DataError(f"{path}: expected a complete scanpath, got: {' '.join(str(error).split())}") from None


def _restored(tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> dict[str, Any]:
    """Make the fields from the tensors and the record, and check that they fit each other."""
    columns, rows = record["grid"]
    grid, cells = Grid(columns, rows, tuple(record["size"])), tensors["cells"]
    count, target, seconds = len(cells), record["target"], record["seconds"]
    check(tensors["values"].shape[-1] == len(grid), "values", f"one for each of {len(grid)} cells",
          tensors["values"].shape[-1])  # fmt: skip
    check(int(cells.max()) < len(grid), "cells", f"cell numbers below {len(grid)}", int(cells.max()))
    check(target is None or 1 <= target < len(record["classes"]), "target", "the index of a class", target)
    check(len(seconds) in (0, count), "seconds", f"times of {count} looks, or none", len(seconds))
    lengths = record["lengths"]
    check(sum(lengths) == len(tensors["mask"]), "lengths", f"a sum of {len(tensors['mask'])}", sum(lengths))
    parts = zip(*(tensors[name].split(lengths) for name in ("boxes", "scores", "mask")), strict=True)
    decision = record["decision"]
    if decision is not None:
        cell = decision["cell"]
        check(cell is None or cell < len(grid), "decision.cell", f"a cell number below {len(grid)}", cell)
        decision = Decision(**decision, box=tensors.get("box"))
    closer = record.get("closer") or []
    boxes = tensors.get("closer_boxes", torch.zeros(0, 4))
    check(len(boxes) == len(closer), "closer_boxes", f"{len(closer)} boxes, one for each closer look", len(boxes))
    for look in closer:
        known = look["cell"] < len(grid) and look["fixation"] < count and 1 <= look["target"] < len(record["classes"])
        check(known, "closer", f"a cell below {len(grid)}, a fixation below {count} and the index of a class", look)
    return {
        "grid": grid,
        "classes": tuple(record["classes"]),
        "target": target,
        "cells": cells,
        "fixations": tensors["fixations"],
        "detections": tuple(Detections(*(part[None] for part in look)) for look in parts),
        "probabilities": tensors["probabilities"],
        "values": tensors["values"],
        "found": record["found"],
        "posterior": tensors.get("posterior"),
        "presence": tensors.get("presence"),
        "decision": decision,
        "closer": tuple(CloserLook(**look, box=box) for look, box in zip(closer, boxes, strict=True)),
        "ending": record["ending"],
        "seconds": tuple(seconds),
        "stimulus": _stimulus(tensors, record),
    }


def _stimulus(tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> Stimulus | None:
    """The stimulus, if it was saved."""
    parts = [tensors.get(name) for name in ("photograph", "canvas")]
    kept = [part for part in parts if part is not None]
    told = [record["placement"] is not None, record["settings"] is not None]
    if not kept and not any(told):
        return None
    check(
        len(kept) == 2 and all(told),
        "photograph",
        "photograph, canvas, placement and settings together",
        f"{len(kept) + sum(told)} of these 4",
    )
    photograph, canvas = kept
    longest = max(photograph.shape[1:])
    check(min(photograph.shape[1:]) >= 1 and longest <= LONGEST, "photograph", f"1 to {LONGEST} px", longest)
    placement = Placement(**{name: tuple(value) for name, value in record["placement"].items()})
    for axis in (0, 1):
        room, side = canvas.shape[2 - axis], placement.size[axis] * placement.scale[axis]
        fits = round(side) >= 1 and placement.offset[axis] + round(side) <= room
        check(fits, "placement", f"the photograph on a canvas of {room} px", f"{side:g} px")
    return Stimulus(photograph, canvas, placement, record["settings"])
