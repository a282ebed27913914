"""A scanpath on disk is the scanpath."""

from dataclasses import fields, replace

import pytest
import torch

from semfov import DataError, Detections, Grid, Scanpath
from semfov.decision import Decision
from semfov.io.storage import read, write


def detections(count):
    generator = torch.Generator().manual_seed(count)
    scores = torch.rand(1, count, 3, generator=generator).softmax(-1)
    return Detections(torch.rand(1, count, 4, generator=generator), scores, torch.ones(1, count).bool())


@pytest.fixture(params=["search", "exploration"])
def scanpath(request):
    grid, cells = Grid(4, 3, (80, 61)), torch.tensor([0, 5])
    explored = Scanpath(
        grid=grid,
        classes=("background", "cup", "cat"),
        target=None,
        cells=cells,
        fixations=grid.centres[cells],
        detections=(detections(3), detections(0)),
        probabilities=torch.rand(2, 12, 3),
        values=torch.randn(2, 12),
        found=False,
        ending="shifts",
        seconds=({"foveate": 0.25}, {"detect": 0.5}),
    )
    if request.param == "exploration":
        return explored
    decision = Decision("found", 0.75, 5, torch.tensor([1.0, 2.0, 3.0, 4.0]))
    more = {"posterior": torch.rand(2, 12), "presence": torch.rand(2), "decision": decision}
    return replace(explored, target=2, found=True, ending="decision", **more)


def same(a, b):
    if isinstance(a, torch.Tensor):
        return torch.equal(a, b)
    if isinstance(a, Detections | Decision):
        return all(same(getattr(a, each.name), getattr(b, each.name)) for each in fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def test_what_is_saved_comes_back(scanpath, tmp_path):
    scanpath.save(tmp_path / "one.safetensors")
    back = Scanpath.load(tmp_path / "one.safetensors")
    for each in fields(Scanpath):
        if each.name != "grid":
            assert same(getattr(scanpath, each.name), getattr(back, each.name)), each.name
    assert (back.grid.columns, back.grid.rows, back.grid.extent.tolist()) == (4, 3, [80, 61])


@pytest.mark.parametrize(
    ("changes", "record", "said"),
    [
        ({"cells": torch.zeros(3, dtype=torch.int64)}, {}, "fixations"),
        ({"count": torch.tensor([3, 1])}, {}, "count"),
        ({"presence": torch.tensor([-1.0, 0.0])}, {}, "presence"),
        ({}, {"grid": [5, 3, 80, 61]}, "grid"),
        ({}, {"ending": "boredom"}, "ending"),
        ({}, {"found": "yes"}, "found"),
        ({}, {"classes": ["background"]}, "classes"),
        ({}, {"kind": "model"}, "expected scanpath, got model"),
    ],
)
def test_files_that_hold_something_else_are_refused(scanpath, tmp_path, changes, record, said):
    path = tmp_path / "one.safetensors"
    scanpath.save(path)
    tensors, told = read(path, "scanpath")
    write(path, tensors | changes, told | record)
    with pytest.raises(DataError, match=rf"one\.safetensors: .*{said}"):
        Scanpath.load(path)


def test_a_damaged_file_is_refused(scanpath, tmp_path):
    path = tmp_path / "one.safetensors"
    scanpath.save(path)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match="damaged"):
        Scanpath.load(path)
