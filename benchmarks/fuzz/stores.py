"""Fuzz files of outcomes and of stored detections: they are read back completely, or count as missing."""

import copy
import json
from pathlib import Path
from typing import Any

import torch

from benchmarks.fuzz.runner import Case, Draw, changed
from semfov.io import storage
from semfov.runs.scene_run import SceneResults
from semfov.runs.store import cell_store

RECORDS = [{"policy": "random", "cells": [1, 2], "found_at": -1}, {"policy": "kl", "cells": [0], "found_at": 0}]
KEY = "a" * 64
SECONDS = {"look": 0.5, "random": 1.25}
JUNK: list[Any] = [None, True, -1, 10**400, 0.5, float("nan"), "", "x", [], [None], {}, {"look": None}, [[[[]]]], "\0"]

PART_DAMAGES = ("none", "value", "signed value", "missing", "deep", "bytes", "bit", "cut", "text")
LOOK_DAMAGES = ("none", "type", "value", "shape", "missing", "more", "key", "bytes", "bit", "cut")


def part_files(draw: Draw, folder: Path) -> Case:
    """`SceneResults.load`: exactly the stored outcomes, or None."""
    results = SceneResults(folder, "1-2", lambda index: "digest")
    results.save(0, RECORDS, SECONDS)
    path = results.path(0)
    damage = draw.choose(PART_DAMAGES, "damage")
    part = json.loads(path.read_text())
    if damage in ("value", "signed value", "missing"):
        key = draw.choose(part, "key")
        part[key] = copy.deepcopy(draw.choose(JUNK, "junk"))
        if damage == "signed value":
            part["sha256"] = results._sha256(0, part["records"], part["seconds"])
        if damage == "missing":
            del part[key]
        path.write_text(json.dumps(part))
    elif damage == "deep":
        path.write_text("[" * 10_000 + "]" * 10_000)
    else:
        path.write_bytes(changed(path.read_bytes(), damage, draw.rng))

    def check(loaded: Any) -> str | None:
        if loaded is None:
            assert damage != "none"
            return "missing"
        same = loaded["records"] == RECORDS and loaded["seconds"] == SECONDS
        forged = damage == "signed value" and (loaded["records"] in ([], {}) or loaded["records"] == RECORDS)
        assert same or (forged and isinstance(loaded["records"], list) and isinstance(loaded["seconds"], dict)), loaded
        return None

    return Case(lambda: results.load(0), check)


def look_files(draw: Draw, folder: Path) -> Case:
    """`LookStore.load`: the stored looks bit for bit, or none."""
    store = cell_store(folder, {"detector": "toy"}, 2, 1, 3)
    generator = torch.Generator().manual_seed(int(draw.rng.integers(2**31)))
    whole = {
        "boxes": torch.rand(3, 4, generator=generator) * 30,
        "scores": torch.rand(3, 3, generator=generator).softmax(-1),
        "count": torch.tensor([1, 2]),
        "actions": torch.tensor([[0.0, 0, 0, 0, 0], [1, 0, 0, 0, 0]], dtype=torch.float64),
    }
    store.write(KEY, whole)
    path = store.path(KEY)
    tensors, record = storage.read(path, "cached-tensors")
    damage = draw.choose(LOOK_DAMAGES, "damage")
    name = draw.choose(tensors, "tensor")
    if damage == "type":
        kinds = (torch.bfloat16, torch.float16, torch.float64, torch.int32, torch.uint8, torch.bool)
        tensors[name] = tensors[name].to(draw.choose(kinds, "dtype"))
    elif damage == "value":
        numbers = (torch.nan, torch.inf, *([-1, 2] if name == "scores" else []))
        tensors[name].view(-1)[0] = draw.choose((-1, 10**6) if name == "count" else numbers, "number")
    elif damage == "shape":
        shapes = (tensors[name][:1].clone(), tensors[name][None], tensors[name].new_zeros(0))
        tensors[name] = draw.choose(shapes, "tensor of another shape")
    elif damage == "missing":
        del tensors[name]
    elif damage == "more":
        tensors["more"] = torch.zeros(1)
    elif damage == "key":
        record[draw.choose(("key", "file", "kind"), "of record")] = draw.choose((None, 1, "x", []), "junk")
    if damage in ("bytes", "bit", "cut"):
        path.write_bytes(changed(path.read_bytes(), damage, draw.rng))
    elif damage != "none":
        storage.write_file(path, tensors, record)

    def check(looks: Any) -> str | None:
        if not looks:
            assert damage != "none"
            return "missing"
        assert [*looks] == [0, 1], damage
        assert torch.cat([look.boxes[0] for look in looks.values()]).equal(whole["boxes"]), damage
        assert torch.cat([look.scores[0] for look in looks.values()]).equal(whole["scores"]), damage
        assert [int(look.count) for look in looks.values()] == [1, 2], damage
        return None

    return Case(lambda: store.load(KEY), check)
