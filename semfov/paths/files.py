"""Files of records: tensors, with JSON values that describe them."""

from collections.abc import Mapping
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, get_args

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
    "box", "decision", "detection", "worth", "shifts", "cells", "passes", "windows", "seconds", "duration", "stopped"
]
"""Reason for the end of a search or an exploration: the gaze was on a given box, the search decided, a detection
showed the target at the gaze in a search whose belief has no thresholds, no look was worth it, all gaze shifts were
made, every cell was fixated, the passes were used up, no window was left that can show the target, the time on this
machine was over, the time of the scene was over, or the caller stopped it."""

WHOLE, POSITIVE, CHANCE = Number(low=0, whole=True), Number(above=0), Number(0, 1)

_DECISION = {"outcome": Text(get_args(Outcome)), "probability": Number(), "cell": Maybe(WHOLE), "place": Maybe(CHANCE)}
_CLOSER = {
    "fixation": Maybe(WHOLE),
    "number": Maybe(WHOLE),
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
}
_OPTIONAL = {
    "confidence": Field(("M",), mixed=True, optional=True),  # files of earlier versions have none
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
    "least": CHANCE,
    "source": Maybe(Text()),
    "shown": Maybe(Object({"white": Json(), "bands": Json()})),
    "detector": Maybe(Text()),
    "ending": Maybe(Text(get_args(Ending))),
    "decision": Maybe(Object(_DECISION, None, tuple(_DECISION))),
    "closer": Array(Object(_CLOSER, None, tuple(_CLOSER))),
}
_PLAIN = "target", "found", "least", "source", "shown", "detector", "ending"


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


class Format:
    """Format of the files of one kind of records: what they have beside the attributes of the base."""

    def __init__(self, kind: str, tensors: Mapping[str, Field], record: Mapping[str, Json]) -> None:
        self.kind = kind
        self.schema = Schema({**tensors, **_DETECTIONS, **_OPTIONAL}, {**_SHARED, **record})

    def write(
        self,
        path: str | PathLike[str],
        fields: Mapping[str, Any],
        tensors: Mapping[str, Tensor],
        record: Mapping[str, Any],
    ) -> None:
        call = _OTHERS.get(Path(path).suffix.lower())
        name = repr(fspath(path))
        check(call is None, "path", "a file of a record, such as 'record.safetensors'", f"{name}; use {call}({name})")
        looks: tuple[Detections, ...] = fields["detections"]
        decision: Decision | None = fields["decision"]
        # The detections of all looks in a row, without padding; `lengths` separates them again.
        names = *_DETECTIONS, "confidence"
        whole = {name: torch.cat([getattr(look, name)[0] for look in looks]) for name in names} | dict(tensors)
        values: dict[str, Any] = {
            "kind": self.kind,
            "version": __version__,
            "classes": list(fields["classes"]),
            "lengths": [look.mask.shape[-1] for look in looks],
            **{name: fields[name] for name in _PLAIN},
            "targets": list(fields["targets"]),
            "decision": decision and {name: getattr(decision, name) for name in _DECISION},
            "closer": [{name: getattr(look, name) for name in _CLOSER} for look in fields["closer"]],
            **record,
        }
        if decision is not None and decision.box is not None:
            whole["box"] = decision.box
        if fields["photograph"] is not None:
            whole["photograph"] = fields["photograph"]
        if fields["closer"]:
            whole["closer_boxes"] = torch.stack([look.box for look in fields["closer"]])
        write_file(path, whole, values)

    def read(self, path: str | PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any], dict[str, Any]]:
        """Read and check a file that `write` wrote: its tensors, its JSON values, and the attributes of the base."""
        tensors, record = read(path, self.kind)
        record.pop("kind")
        unknown = record.keys() - self.schema.record.keys()
        check(not unknown, "record", f"no other values than {', '.join(self.schema.record)}", sorted(unknown))
        self.schema.check(tensors, record)
        classes, lengths, targets = (record[name] for name in ("classes", "lengths", "targets"))
        target, photograph = record.get("target"), tensors.get("photograph")
        check(target is None or 1 <= target < len(classes), "target", "the index of a class", target)
        check(sum(lengths) == len(tensors["mask"]), "lengths", f"a sum of {len(tensors['mask'])}", sum(lengths))
        check(all(1 <= each < len(classes) for each in targets), "targets", "indices of classes", targets)
        sides = (1,) if photograph is None else photograph.shape[1:]
        check(min(sides) >= 1 and max(sides) <= LONGEST, "photograph", f"1 to {LONGEST} px", max(sides))
        names = [name for name in (*_DETECTIONS, "confidence") if name in tensors]
        looks = zip(*(tensors[name].split(lengths) for name in names), strict=True)
        decision, closer = record.get("decision"), record["closer"]
        boxes = tensors.get("closer_boxes", torch.zeros(0, 4))
        check(len(boxes) == len(closer), "closer_boxes", f"{len(closer)} boxes, one for each closer look", len(boxes))
        for look in closer:
            last = max(look["fixation"] or 0, look["number"] or 0)
            fits = last < len(lengths) and 1 <= look["target"] < len(classes)
            check(fits, "closer", f"a look below {len(lengths)} and the index of a class", look)
        shared = {
            **{name: record.get(name) for name in _PLAIN},
            "classes": tuple(classes),
            "targets": tuple(targets),
            "photograph": photograph,
            "detections": tuple(Detections(*(part[None] for part in look)) for look in looks),
            "decision": None if decision is None else Decision(**decision, box=tensors.get("box")),
            "closer": tuple(CloseUp(**look, box=box) for look, box in zip(closer, boxes, strict=True)),
        }
        return tensors, record, shared
