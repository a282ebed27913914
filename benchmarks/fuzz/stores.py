"""Fuzz files of outcomes and of stored detections: they are read back completely, or count as missing."""

import copy
import json
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import torch

from benchmarks.fuzz.runner import Case, Draw, changed
from semfov.io import storage
from semfov.runs.results import SceneResults
from semfov.runs.store import cell_store

RECORDS = [{"policy": "random", "cells": [1, 2], "found_at": -1}, {"policy": "kl", "cells": [0], "found_at": 0}]
KEY = "a" * 64
SECONDS = {"look": 0.5, "random": 1.25}
JUNK: list[Any] = [None, True, -1, 10**400, 0.5, float("nan"), "", "x", [], [None], {}, {"look": None}, [[[[]]]], "\0"]

PART_DAMAGES = ("none", "value", "signed value", "missing", "deep", "bytes", "bit", "cut", "text")
LOOK_DAMAGES = ("none", "type", "value", "shape", "missing", "more", "key", "bytes", "bit", "cut")


def part_files(draw: Draw, folder: Path) -> Case:
    """`SceneResults.items`: exactly the stored outcomes, or None."""
    results = SceneResults(folder, "1-2", lambda index: "digest")
    results.save(0, RECORDS, SECONDS)
    damage = draw.choose(PART_DAMAGES, "damage")
    if damage in ("value", "signed value", "missing", "deep"):
        row = {"seconds": json.dumps(SECONDS), "records": json.dumps(RECORDS)}
        key = draw.choose(row, "key")
        row[key] = json.dumps(copy.deepcopy(draw.choose(JUNK, "junk")))
        if damage == "deep":
            row[key] = "[" * 10_000 + "]" * 10_000
        signed = results._sha256(0, row["seconds"], row["records"])
        with closing(sqlite3.connect(results.path)) as database, database:
            if damage == "missing":
                database.execute("DELETE FROM scenes")
            database.execute("UPDATE scenes SET seconds = ?, records = ?", (row["seconds"], row["records"]))
            if damage in ("signed value", "deep"):
                database.execute("UPDATE scenes SET sha256 = ?", (signed,))
    else:
        results.path.write_bytes(changed(results.path.read_bytes(), damage, draw.rng))

    def check(loaded: Any) -> str | None:
        if loaded is None:
            assert damage != "none"
            return "missing"
        same = loaded["records"] == RECORDS and loaded["seconds"] == SECONDS
        forged = damage == "signed value" and (loaded["records"] in ([], {}) or loaded["records"] == RECORDS)
        assert same or (forged and isinstance(loaded["records"], list) and isinstance(loaded["seconds"], dict)), loaded
        return None

    return Case(lambda: dict(results.items(1)).get(0), check)


def look_files(draw: Draw, folder: Path) -> Case:
    """`DetectionStore.load`: the stored looks bit for bit, or none."""
    store = cell_store(folder, {"detector": "toy"}, 2, 1, 3)
    generator = torch.Generator().manual_seed(int(draw.rng.integers(2**31)))
    whole = {
        "boxes": torch.rand(3, 4, generator=generator) * 30,
        "scores": torch.rand(3, 3, generator=generator).softmax(-1),
        "confidence": torch.rand(3, generator=generator),
        "highest": torch.rand(2, 3, generator=generator).softmax(-1),
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
        numbers = (torch.nan, torch.inf, *([-1, 2] if name in ("scores", "highest") else []))
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
        assert torch.cat([look.highest for look in looks.values()]).equal(whole["highest"]), damage
        assert [int(look.count) for look in looks.values()] == [1, 2], damage
        return None

    return Case(lambda: store.load(KEY), check)
