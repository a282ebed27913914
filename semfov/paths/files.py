"""Files of records: tensors, with JSON values that describe them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any, Self, get_args

import torch
from torch import Tensor

from semfov.decision import CloseUp, Decision, Outcome
from semfov.detection.detections import Detections
from semfov.errors import DataError, InputError, check
from semfov.io.schema import Array, Field, Flag, Json, Maybe, Number, Object, Pair, Schema, Size, Text
from semfov.io.storage import read, write_file
from semfov.paths.endings import Ending
from semfov.paths.stimulus import LONGEST
from semfov.version import __version__

WHOLE, POSITIVE, CHANCE = Number(low=0, whole=True), Number(above=0), Number(0, 1)

_DECISION = {
    "outcome": Text(get_args(Outcome)),
    "probability": Number(),
    "cell": Maybe(WHOLE),
    "place": Maybe(CHANCE),
}
_CLOSER = {"fixation": WHOLE, "target": WHOLE, "cell": WHOLE, "number": WHOLE, "place": CHANCE, "presence": CHANCE}
_DETECTIONS = {
    "boxes": Field(("M", 4), mixed=True),
    "scores": Field(("M", "C"), mixed=True),
    "mask": Field(("M",), dtype=torch.bool),
}

_BOXES: dict[str, tuple[Size, ...]] = {"box": (4,), "closer_boxes": ("Q", 4)}
_PHOTOGRAPH = Field((3, "h", "w"), dtype=torch.uint8, optional=True)


def pair(of: Json) -> Pair:
    """Requirements of two values of one kind."""
    return Pair((of, of))


@dataclass(frozen=True)
class Format:
    """Format of the files of one kind of records."""

    kind: str
    schema: Schema
    closer: tuple[str, ...]

    @classmethod
    def of(
        cls,
        kind: str,
        tensors: Mapping[str, Field],
        record: Mapping[str, Json],
        *,
        endings: Sequence[Ending],
        closer: Sequence[str],
    ) -> Self:
        """Make the format of a kind from what its records have beside the attributes of the base."""
        shared: dict[str, Json] = {
            "version": Text(),
            "classes": Array(Text(), "C", least=2),
            "lengths": Array(WHOLE, "n", least=1),
            "target": Maybe(WHOLE),
            "found": Flag(),
            "decision": Maybe(Object(_DECISION, None, tuple(_DECISION))),
            "closer": Array(Object({name: _CLOSER[name] for name in closer}, None, tuple(closer))),
            "targets": Array(WHOLE),
            "least": CHANCE,
            "source": Maybe(Text()),
            "ending": Maybe(Text(tuple(endings))),
        }
        boxes = {name: Field(shape, mixed=True, optional=True) for name, shape in _BOXES.items()}
        boxes["photograph"] = _PHOTOGRAPH
        return cls(kind, Schema({**tensors, **_DETECTIONS, **boxes}, shared | dict(record)), tuple(closer))

    def write(
        self,
        path: str | PathLike[str],
        fields: Mapping[str, Any],
        tensors: Mapping[str, Tensor],
        record: Mapping[str, Any],
    ) -> None:
        """Write a record to a file atomically."""
        looks: tuple[Detections, ...] = fields["detections"]
        decision: Decision | None = fields["decision"]
        # The detections of all looks in a row, without padding; `lengths` separates them again.
        whole = {name: torch.cat([getattr(look, name)[0] for look in looks]) for name in _DETECTIONS} | dict(tensors)
        values: dict[str, Any] = {
            "kind": self.kind,
            "version": __version__,
            "classes": list(fields["classes"]),
            "lengths": [look.mask.shape[-1] for look in looks],
            **{name: fields[name] for name in ("target", "found", "ending", "least", "source")},
            "targets": list(fields["targets"]),
            "decision": None,
            "closer": [{name: getattr(look, name) for name in self.closer} for look in fields["closer"]],
            **record,
        }
        if decision is not None:
            values["decision"] = {name: getattr(decision, name) for name in _DECISION}
            if decision.box is not None:
                whole["box"] = decision.box
        if fields["photograph"] is not None:
            whole["photograph"] = fields["photograph"]
        if fields["closer"]:
            whole["closer_boxes"] = torch.stack([look.box for look in fields["closer"]])
        write_file(path, whole, values)

    def read(self, path: str | PathLike[str]) -> tuple[dict[str, Tensor], dict[str, Any], dict[str, Any]]:
        """Read a file that `write_file` wrote, and check it."""
        tensors, record = read(path, self.kind)
        record.pop("kind")
        unknown = record.keys() - self.schema.record.keys()
        check(not unknown, "record", f"no other values than {', '.join(self.schema.record)}", sorted(unknown))
        self.schema.check(tensors, record)
        return tensors, record, self._restored(tensors, record)

    def refused(self, path: str | PathLike[str], error: InputError) -> DataError:
        """The error that reports a file with wrong content."""
        return DataError(f"{path}: expected a complete {self.kind}, got: {' '.join(str(error).split())}")

    def _restored(self, tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> dict[str, Any]:
        """Make the attributes of the base, and check that they fit each other."""
        classes, target, lengths = tuple(record["classes"]), record.get("target"), record["lengths"]
        check(target is None or 1 <= target < len(classes), "target", "the index of a class", target)
        check(sum(lengths) == len(tensors["mask"]), "lengths", f"a sum of {len(tensors['mask'])}", sum(lengths))
        targets = tuple(record["targets"])
        check(all(1 <= each < len(classes) for each in targets), "targets", "indices of classes", targets)
        photograph = tensors.get("photograph")
        sides = (1,) if photograph is None else photograph.shape[1:]
        check(min(sides) >= 1 and max(sides) <= LONGEST, "photograph", f"1 to {LONGEST} px", max(sides))
        looks = zip(*(tensors[name].split(lengths) for name in _DETECTIONS), strict=True)
        decision, closer = record.get("decision"), record["closer"]
        boxes = tensors.get("closer_boxes", torch.zeros(0, 4))
        check(len(boxes) == len(closer), "closer_boxes", f"{len(closer)} boxes, one for each closer look", len(boxes))
        for look in closer:
            number = look.get("fixation", look.get("number"))
            fits = number < len(lengths) and 1 <= look["target"] < len(classes)
            check(fits, "closer", f"a look below {len(lengths)} and the index of a class", look)
        return {
            "classes": classes,
            "target": target,
            "targets": targets,
            "least": record["least"],
            "source": record.get("source"),
            "photograph": photograph,
            "detections": tuple(Detections(*(part[None] for part in look)) for look in looks),
            "found": record["found"],
            "decision": None if decision is None else Decision(**decision, box=tensors.get("box")),
            "closer": tuple(
                CloseUp(**{"fixation": None, "cell": None} | look, box=box)
                for look, box in zip(closer, boxes, strict=True)
            ),
            "ending": record.get("ending"),
        }
