"""Files of records: tensors, with JSON values that describe them."""

from collections.abc import Mapping, Sequence
from math import nextafter
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, Protocol, TypedDict, get_args

import torch
from torch import Tensor

from semfov.decision import CloseUp, Decision, Outcome
from semfov.detection.detections import Detections
from semfov.errors import check
from semfov.io.schema import Array, Field, Flag, Json, Maybe, Number, Object, Schema, Text
from semfov.io.storage import read, write_file
from semfov.paths.stimulus import LONGEST
from semfov.version import __version__

Ending = Literal[
    "box", "decision", "detection", "min_gain", "shifts", "cells", "passes", "windows", "seconds", "duration", "stopped"
]
"""Reason for the end of a search or an exploration: the gaze was on a given box, the search decided, a detection
showed the target at the gaze in a search whose belief has no thresholds, no look was worth it, all gaze shifts were
made, every cell was fixated, the passes were used up, no window was left that can show the target, the time on this
machine was over, the time of the scene was over, or the caller stopped it."""

WHOLE = Number(low=0, whole=True)
POSITIVE = Number(above=0)
CHANCE = Number(0, 1)
_SHARE = Number(above=0, high=nextafter(1, 0))

_DECISION = {
    "outcome": Text(get_args(Outcome)),
    "probability": Number(),
    "cell": Maybe(WHOLE),
    "place": Maybe(CHANCE),
    "confirm": Maybe(Number()),
}
_CLOSER = {
    "fixation": Maybe(WHOLE),
    "index": Maybe(WHOLE),
    "target": WHOLE,
    "cell": Maybe(WHOLE),
    "place": CHANCE,
    "presence": CHANCE,
}
FARTHEST = 2.0**24  # largest coordinate in pixels, up to which float32 holds every whole pixel

_DETECTIONS = {
    "boxes": Field(("M", 4), mixed=True, low=-FARTHEST, high=FARTHEST),
    "scores": Field(("M", "C"), mixed=True),
    "mask": Field(("M",), dtype=torch.bool),
    "confidence": Field(("M",), mixed=True),
    "highest": Field(("N", "C"), mixed=True),
}
_ROWS = ("boxes", "scores", "mask", "confidence")  # of M detections; the highest scores are of N looks
_OPTIONAL = {
    "box": Field((4,), mixed=True, low=-FARTHEST, high=FARTHEST, optional=True),
    "closer_boxes": Field(("Q", 4), mixed=True, low=-FARTHEST, high=FARTHEST, optional=True),
    "photograph": Field((3, "h", "w"), dtype=torch.uint8, optional=True),
}
_SHARED = {
    "version": Text(),
    "classes": Array(Text(), "C", least=2),
    "lengths": Array(WHOLE, "n", least=1),
    "target": Maybe(WHOLE),
    "targets": Array(WHOLE),
    "found": Flag(),
    "prior": Maybe(_SHARE),
    "assumed": Maybe(_SHARE),
    "score_threshold": CHANCE,
    "source": Maybe(Text()),
    "shown": Maybe(Object({"white": Json(), "bands": Json()})),
    "detector": Maybe(Text()),
    "ending": Maybe(Text(get_args(Ending))),
    "decision": Maybe(Object(_DECISION, None, tuple(_DECISION))),
    "closer": Array(Object(_CLOSER, None, tuple(_CLOSER))),
}
PLAIN = ("target", "found", "prior", "assumed", "score_threshold", "source", "shown", "detector", "ending")
"""Attributes that are JSON values of a file by their own names; those of `SharedFields` are made of several values."""


_OTHERS = {
    ".csv": "record.to_csv",
    ".json": "record.to_json",
    ".geojson": "record.to_geojson",
    ".xlsx": "record.to_frame().to_excel",
    ".html": "record.report",
    ".htm": "record.report",
    ".gif": "record.animate",
    **dict.fromkeys((".png", ".jpg", ".jpeg", ".pdf", ".svg"), "record.plot().savefig"),
}
"""Calls that write files with these ends of names."""


class _Shared(Protocol):
    """What all records have, beside the attributes that are JSON values."""

    @property
    def classes(self) -> Sequence[str]: ...
    @property
    def targets(self) -> Sequence[int]: ...
    @property
    def detections(self) -> Sequence[Detections]: ...
    @property
    def decision(self) -> Decision | None: ...
    @property
    def closer(self) -> Sequence[CloseUp]: ...
    @property
    def photograph(self) -> Tensor | None: ...


class SharedFields(TypedDict):
    """Attributes that all records have beside the plain ones, by name, as the file of a record gives them."""

    classes: tuple[str, ...]
    targets: tuple[int, ...]
    detections: tuple[Detections, ...]
    decision: Decision | None
    closer: tuple[CloseUp, ...]
    photograph: Tensor | None


class Format:
    """Format of the files of one kind of records.

    A file is one of safetensors. Detections of all looks stand in a row, without padding, and `lengths` separates them.

    Args:
        kind: name of the kind, which a file holds.
        tensors: tensors beside those of all records, such as detections.
        record: JSON values beside those of all records.
    """

    def __init__(self, kind: str, tensors: Mapping[str, Field], record: Mapping[str, Json]) -> None:
        self.kind = kind
        self.schema = Schema({**tensors, **_DETECTIONS, **_OPTIONAL}, {**_SHARED, **record})

    def write(
        self,
        path: str | PathLike[str],
        outcome: _Shared,
        tensors: Mapping[str, Tensor | None],
        record: Mapping[str, Any],
    ) -> None:
        """Write the file of a record, atomically.

        Args:
            path: the file.
            outcome: the record, whose attributes that all records have are written.
            tensors: the tensors of its kind; those that are None are left out.
            record: the JSON values of its kind.

        Raises:
            InputError: the name is that of a table, a page, a picture or a film.
            DataError: the file cannot be written.
        """
        call = _OTHERS.get(Path(path).suffix.lower())
        name = repr(fspath(path))
        check(call is None, "path", "a file of a record, such as 'record.safetensors'", f"{name}; use {call}({name})")
        decision = outcome.decision
        values = {
            "kind": self.kind,
            "version": __version__,
            "classes": list(outcome.classes),
            "lengths": [look.mask.shape[-1] for look in outcome.detections],
            **{name: getattr(outcome, name) for name in PLAIN},
            "targets": list(outcome.targets),
            "decision": None if decision is None else _decision_values(decision),
            "closer": [{name: getattr(look, name) for name in _CLOSER} for look in outcome.closer],
            **record,
        }
        all_tensors = {**_shared_tensors(outcome), **tensors}
        write_file(path, {name: tensor for name, tensor in all_tensors.items() if tensor is not None}, values)

    def read(self, path: str | PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any], SharedFields]:
        """Read and check a file that `write` wrote.

        Args:
            path: the file.

        Returns:
            Its tensors, its JSON values, and the attributes of all records that are made of these.

        Raises:
            InputError: a value is missing, or does not suit the others.
            DataError: the file is missing or damaged, or of another kind.
        """
        tensors, record = read(path, self.kind)
        record.pop("kind")
        unknown = record.keys() - self.schema.record.keys()
        check(not unknown, "record", f"no other values than {', '.join(self.schema.record)}", sorted(unknown))
        self.schema.check(tensors, record)
        _check_shared(tensors, record)
        return tensors, record, _shared_fields(tensors, record)


def _decision_values(decision: Decision) -> dict[str, Any]:
    """Make the JSON values of a decision, whose box is a tensor of the file."""
    return {name: getattr(decision, name) for name in _DECISION}


def _shared_fields(tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> SharedFields:
    """Make the attributes that all records have beside the plain ones from the checked content of a file."""
    decision = record.get("decision")
    closer_boxes = tensors.get("closer_boxes", torch.zeros(0, 4))
    close_ups = zip(record["closer"], closer_boxes, strict=True)
    return {
        "classes": tuple(record["classes"]),
        "targets": tuple(record["targets"]),
        "detections": _separated(tensors, record["lengths"]),
        "decision": None if decision is None else Decision(**decision, box=tensors.get("box")),
        "closer": tuple(CloseUp(**values, box=box) for values, box in close_ups),
        "photograph": tensors.get("photograph"),
    }


def _shared_tensors(outcome: _Shared) -> dict[str, Tensor | None]:
    """Collect the tensors that all records have: detections, the photograph, and boxes of decision and closer looks."""
    tensors: dict[str, Tensor | None] = {}
    for name in _ROWS:
        # Batches of one become rows, one look after the other.
        tensors[name] = torch.cat([getattr(look, name)[0] for look in outcome.detections])
    tensors["highest"] = torch.cat([look.highest for look in outcome.detections])
    tensors["box"] = None if outcome.decision is None else outcome.decision.box
    tensors["photograph"] = outcome.photograph
    tensors["closer_boxes"] = torch.stack([look.box for look in outcome.closer]) if outcome.closer else None
    return tensors


def _separated(tensors: Mapping[str, Tensor], lengths: list[int]) -> tuple[Detections, ...]:
    """Separate the detections of the looks, which stand in a row in a file; return batches of one.

    Args:
        tensors: boxes `(M, 4)`, scores, mask and confidence of all N looks, and their highest scores `(N, C)`.
        lengths: number of detections of each look, with sum M.
    """
    columns = [tensors[name].split(lengths) for name in _ROWS]
    looks = []
    for parts in zip(*columns, tensors["highest"], strict=True):
        batch_of_one = [part[None] for part in parts]
        looks.append(Detections(*batch_of_one))
    return tuple(looks)


def _check_shared(tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> None:
    """Raise `InputError` where values of a file, each of which is allowed, do not suit each other."""
    classes = len(record["classes"])
    lengths = record["lengths"]
    target = record.get("target")
    check(target is None or _is_class(target, classes), "target", "the index of a class", target)
    rows = len(tensors["mask"])
    check(sum(lengths) == rows, "lengths", f"a sum of {rows}", sum(lengths))
    check(len(lengths) == len(tensors["highest"]), "lengths", f"{len(tensors['highest'])} looks", len(lengths))
    targets = record["targets"]
    check(all(_is_class(label, classes) for label in targets), "targets", "indices of classes", targets)
    if "photograph" in tensors:
        sides = tensors["photograph"].shape[1:]
        has_size = min(sides) >= 1 and max(sides) <= LONGEST
        check(has_size, "photograph", f"1 to {LONGEST} px", max(sides))
    closer_boxes = len(tensors.get("closer_boxes", ()))
    _check_closer(record["closer"], closer_boxes, len(lengths), classes)


def _check_closer(closer: Sequence[Mapping[str, Any]], boxes: int, looks: int, classes: int) -> None:
    """Raise `InputError` unless each closer look has a box, and is of a look and of a class of the record."""
    check(boxes == len(closer), "closer_boxes", f"{len(closer)} boxes, one for each closer look", boxes)
    expected = f"a look below {looks} and the index of a class"
    for values in closer:
        # Either number may be missing, and neither may be beyond the looks.
        look = max(values["fixation"] or 0, values["index"] or 0)
        check(look < looks and _is_class(values["target"], classes), "closer", expected, values)


def _is_class(label: int, classes: int) -> bool:
    """Tell whether a number is the index of one of the classes, of which the first is the background."""
    return 1 <= label < classes


def check_decided_cell(decision: Decision | None, cells: int) -> None:
    """Raise `InputError` unless the cell of the decision of a file, if it has one, is a cell of its grid."""
    cell = None if decision is None else decision.cell
    check(cell is None or cell < cells, "decision.cell", f"a cell number below {cells}", cell)
