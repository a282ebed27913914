"""Fuzz files of outcomes and of stored detections: they are read back completely, or count as missing."""

import copy
import json
import tempfile
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st

from benchmarks.fuzz.models import changed
from benchmarks.fuzz.runner import choose, draw_rng
from semfov.io import storage
from semfov.runs.results import SceneResults
from semfov.runs.store import cell_store

RECORDS = [{"policy": "random", "cells": [1, 2], "found_at": -1}, {"policy": "kl", "cells": [0], "found_at": 0}]
SECONDS = {"look": 0.5, "random": 1.25}
JUNK: list[Any] = [None, True, -1, 10**400, 0.5, float("nan"), "", "x", [], [None], {}, {"look": None}, [[[[]]]], "\0"]

PART_DAMAGES = ("none", "value", "signed value", "missing", "deep", "bytes", "bit", "cut", "text")
LOOK_DAMAGES = ("none", "type", "value", "shape", "missing", "more", "key", "bytes", "bit", "cut")


def part_files(data: st.DataObject) -> str:
    """`Parts.load`: exactly the stored outcomes, or None."""
    rng = draw_rng(data)
    with tempfile.TemporaryDirectory() as folder:
        results = SceneResults(Path(folder), "1-2", lambda index: "digest")
        results.save(0, RECORDS, SECONDS)
        path = results.path(0)
        damage = choose(data, PART_DAMAGES, "how")
        part = json.loads(path.read_text())
        if damage in ("value", "signed value", "missing"):
            key = choose(data, list(part), "key")
            part[key] = copy.deepcopy(choose(data, JUNK, "junk"))
            if damage == "signed value":
                part["sha256"] = results._sha256(0, part["records"], part["seconds"])
            if damage == "missing":
                del part[key]
            path.write_text(json.dumps(part))
        elif damage == "deep":
            path.write_text("[" * 10_000 + "]" * 10_000)
        elif damage != "none":
            path.write_bytes(changed(path.read_bytes(), damage, rng))
        loaded = results.load(0)
    if loaded is None:
        assert damage != "none"
        return "missing"
    same = loaded["records"] == RECORDS and loaded["seconds"] == SECONDS
    forged = damage == "signed value" and (loaded["records"] in ([], {}) or loaded["records"] == RECORDS)
    assert same or (forged and isinstance(loaded["records"], list) and isinstance(loaded["seconds"], dict)), loaded
    return "result"


def look_files(data: st.DataObject) -> str:
    """`LookStore.load`: the stored looks bit for bit, or none."""
    rng = draw_rng(data)
    with tempfile.TemporaryDirectory() as folder:
        store = cell_store(Path(folder), {"detector": "toy"}, 2, 1, 3)
        generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
        whole = {
            "boxes": torch.rand(3, 4, generator=generator) * 30,
            "scores": torch.rand(3, 3, generator=generator).softmax(-1),
            "count": torch.tensor([1, 2]),
            "actions": torch.tensor([[0.0, 0, 0, 0, 0], [1, 0, 0, 0, 0]], dtype=torch.float64),
        }
        store.write("a" * 64, whole)
        path = store.path("a" * 64)
        tensors, record = storage.read(path, "cached-tensors")
        damage = choose(data, LOOK_DAMAGES, "how")
        name = choose(data, list(tensors), "tensor")
        if damage == "type":
            kinds = (torch.bfloat16, torch.float16, torch.float64, torch.int32, torch.uint8, torch.bool)
            tensors[name] = tensors[name].to(choose(data, kinds, "dtype"))
        elif damage == "value":
            numbers = (torch.nan, torch.inf, *([-1, 2] if name == "scores" else []))
            wrong = (-1, 10**6) if name == "count" else numbers
            tensors[name].view(-1)[0] = choose(data, wrong, "number")
        elif damage == "shape":
            shapes = (tensors[name][:1].clone(), tensors[name][None], tensors[name].new_zeros(0))
            tensors[name] = choose(data, shapes, "tensor of another shape")
        elif damage == "missing":
            del tensors[name]
        elif damage == "more":
            tensors["more"] = torch.zeros(1)
        elif damage == "key":
            record[choose(data, ("key", "file", "kind"), "of record")] = choose(data, (None, 1, "x", []), "junk")
        if damage in ("bytes", "bit", "cut"):
            path.write_bytes(changed(path.read_bytes(), damage, rng))
        elif damage != "none":
            storage.write_file(path, tensors, record)
        looks = store.load("a" * 64)
    if not looks:
        assert damage != "none"
        return "missing"
    assert [*looks] == [0, 1], damage
    assert torch.cat([look.boxes[0] for look in looks.values()]).equal(whole["boxes"]), damage
    assert torch.cat([look.scores[0] for look in looks.values()]).equal(whole["scores"]), damage
    assert [int(look.count) for look in looks.values()] == [1, 2], damage
    return "result"
