"""One store of looks for all kinds of actions: what it reads is what was written, or nothing."""

import threading

import pytest
import torch

from semfov.detection import Detections
from semfov.runs import store as store_module
from semfov.runs.looks import LOOK_SOURCES
from semfov.runs.store import DetectionStore, RememberedLooks, cell_store
from semfov.runs.zoom_store import WindowLookStore
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook

DIGEST = "a" * 64
LATTICE = Lattice.over((640, 480), (128, 128))


def detections(seed, count):
    generator = torch.Generator().manual_seed(seed)
    boxes = torch.rand(1, count, 4, generator=generator) * 30
    return Detections(boxes, torch.rand(1, count, 4, generator=generator).softmax(-1), torch.ones(1, count).bool())


def look(number, window):
    seen = detections(number, 1 + number % 3)
    cut = torch.rand(len(seen.boxes[0]), generator=torch.Generator().manual_seed(number)) > 0.5
    summary = None
    if window.within is None and window.level < LATTICE.levels - 1:
        scores = torch.zeros(4, 4, 3)
        scores[1, 2, 0] = 0.25
        summary = Gist(window.level, window.cells[:2], 2, scores, scores.amax(-1) * 8, scores > 0.1)
    return WindowLook(window, seen, cut, torch.tensor([0.25, 0.0, 0.5]), summary)


def cells(folder, **settings):
    return cell_store(folder, {"detector": "toy", **settings}, 3, 2, 4)


def poses(folder, **settings):
    return DetectionStore(folder, {"fields": [60.0], **settings}, (*LOOK_SOURCES, "semfov.head.views"), 4)


def windows(folder, **settings):
    return WindowLookStore(folder, {"detector": "toy", **settings}, 3)


NUMBERED = {5: detections(5, 2), 0: detections(0, 0), 3: detections(3, 1)}
BOXED = {(1.0, 2.5, 30.1, 40.0): detections(7, 2), (0.0, 0.0, 1 / 3, 1.0): detections(8, 1)}
WINDOWS = [
    Window.on(LATTICE, (0, 0, 0)),
    Window.on(LATTICE, (1, 2, 1)),
    Window.around(LATTICE, (10.0, 20.0, 110.5, 120.0)),
]
WINDOW_LOOKS = {window: look(number, window) for number, window in enumerate(WINDOWS)}

KINDS = {
    "cells": (cells, NUMBERED),
    "cells and boxes": (cells, NUMBERED | BOXED),
    "boxes": (cells, BOXED),
    "poses and cells": (poses, {100 * pose + 7: detections(pose, pose) for pose in range(3)}),
    "windows": (windows, WINDOW_LOOKS),
}


@pytest.fixture(params=KINDS)
def kind(request):
    return KINDS[request.param]


def tensors_of(look):
    if isinstance(look, Detections):
        return [look.boxes, look.scores, look.mask]
    summary = look.gist
    more = [] if summary is None else [summary.scores, summary.size, summary.found]
    return [*tensors_of(look.detections), look.cut, look.show, *more]


def assert_equal(found, expected):
    assert set(found) == set(expected)
    for action, look in expected.items():
        for one, other in zip(tensors_of(found[action]), tensors_of(look), strict=True):
            assert torch.equal(one, other)
        if isinstance(look, WindowLook):
            assert found[action].window == look.window
            assert (found[action].gist is None) == (look.gist is None)
            if look.gist is not None:
                assert vars(found[action].gist).keys() == vars(look.gist).keys()
                assert found[action].gist.first == look.gist.first
                assert (found[action].gist.level, found[action].gist.scale) == (look.gist.level, look.gist.scale)


def test_looks_are_read_as_they_were_written_in_any_order(kind, tmp_path):
    make, looks = kind
    store = make(tmp_path)
    assert store.load(DIGEST) == {}
    store.save(DIGEST, looks)
    assert_equal(make(tmp_path).load(DIGEST), looks)
    assert store.load("b" * 64) == {}
    make, looks = kind
    store = make(tmp_path)
    store.save(DIGEST, looks)
    before = store.path(DIGEST).read_bytes()
    store.save(DIGEST, dict(reversed(looks.items())))
    assert store.path(DIGEST).read_bytes() == before


def test_damaged_files_count_as_missing(kind, tmp_path):
    make, looks = kind
    store = make(tmp_path)
    store.save(DIGEST, looks)
    path = store.path(DIGEST)
    whole, tensors = path.read_bytes(), store.read(DIGEST)
    for damage in (whole[: len(whole) // 2], b"", whole[:-40] + bytes([whole[-40] ^ 1]) + whole[-39:]):
        path.write_bytes(damage)
        assert store.load(DIGEST) == {}
    count = tensors["count"].clone()
    count[0] += 1
    for name, spoiled in (
        ("actions", tensors["actions"] * torch.nan),
        ("actions", tensors["actions"][:, :-1].clone()),
        ("scores", tensors["scores"] + 1),
        ("count", count),
        ("count", tensors["count"][1:].clone()),
    ):
        store.write(DIGEST, {**tensors, name: spoiled})
        assert store.load(DIGEST) == {}
    store.write(DIGEST, {name: tensor for name, tensor in tensors.items() if name != "actions"})
    assert store.load(DIGEST) == {}
    path.write_bytes(whole)
    other = store.path("b" * 64)
    other.parent.mkdir()
    path.rename(other)
    assert store.load("b" * 64) == {}, "the file of another scene"


def test_looks_of_other_settings_versions_and_code_are_not_read(kind, tmp_path, monkeypatch):
    make, looks = kind
    store = make(tmp_path)
    store.save(DIGEST, looks)
    others = [make(tmp_path, another="eye")]
    with monkeypatch.context() as changed:
        changed.setattr(store_module, "__version__", "0.0.0")
        others.append(make(tmp_path))
    with monkeypatch.context() as changed:
        changed.setattr(store_module, "modules_digest", lambda *modules: "0" * 64)
        others.append(make(tmp_path))
    for other in others:
        assert other.key != store.key
        assert other.load(DIGEST) == {}
        other.folder = store.folder
        assert other.load(DIGEST) == {}
    assert_equal(make(tmp_path).load(DIGEST), looks)


def test_looks_are_computed_once_on_one_thread_and_stored_when_a_run_is_stopped(kind, tmp_path):
    make, looks = kind
    opened, made = [], []

    def open_scene():
        opened.append(True)

        def look(action):
            assert torch.get_num_threads() == 1
            if len(made) == 1:
                made.append(None)
                raise KeyboardInterrupt
            made.append(action)
            return looks[action]

        return look

    first, second, *_ = looks
    source = RememberedLooks(open_scene, make(tmp_path), lambda: DIGEST)
    assert source(first) is source(first)
    with pytest.raises(KeyboardInterrupt):
        source(second)
    source.close()
    assert_equal(make(tmp_path).load(DIGEST), {first: looks[first]})
    again = RememberedLooks(open_scene, make(tmp_path), lambda: DIGEST)
    again(first)
    assert len(opened) == 1, "no look was missing"
    for action in looks:
        again(action)
    assert made == [first, None, *(action for action in looks if action != first)]
    again.close()
    assert_equal(again.looks, looks)
    assert_equal(make(tmp_path).load(DIGEST), looks)


def test_a_source_without_a_store_keeps_its_looks_in_memory(kind):
    _, looks = kind
    source = RememberedLooks(lambda: looks.__getitem__)
    for action in looks:
        source(action)
    source.close()
    assert source.looks == looks


def test_a_file_is_written_only_when_there_are_new_looks(kind, tmp_path):
    make, looks = kind
    make(tmp_path).save(DIGEST, looks)
    path = make(tmp_path).path(DIGEST)
    before = path.stat().st_mtime_ns
    source = RememberedLooks(lambda: looks.__getitem__, make(tmp_path), lambda: DIGEST)
    for action in looks:
        source(action)
    source.save()
    assert path.stat().st_mtime_ns == before


def test_concurrent_writers_leave_whole_files(kind, tmp_path):
    make, looks = kind
    some = dict([*looks.items()][:1])
    store, other = make(tmp_path), make(tmp_path)
    store.save(DIGEST, looks)

    def write():
        for _ in range(20):
            other.save(DIGEST, some)
            other.save(DIGEST, looks)

    writers = [threading.Thread(target=write) for _ in range(2)]
    for writer in writers:
        writer.start()
    while any(writer.is_alive() for writer in writers):
        found = store.load(DIGEST)
        if found:  # a file that is replaced while it is opened counts as missing
            assert_equal(found, looks if len(found) == len(looks) else some)
    for writer in writers:
        writer.join()
    assert_equal(store.load(DIGEST), looks)
    assert not list(tmp_path.rglob("*.part"))
