"""Many pictures by one call of Python: what the command writes, with files of each object."""

import csv
import os
import shutil
import signal
import threading

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

import semfov
from semfov import DataError, InputError, read_image
from semfov.cli.options import FindOptions
from semfov.cli.search import _FindJob
from semfov.gaze.policies import Policy
from semfov.runs.command import run_command
from semfov.runs.scene_run import digest_of
from semfov.runs.settings import Settings


@pytest.fixture
def flight(photo, tmp_path):
    """Two pictures in folders of a folder, one of them without an object, and one that is none."""
    folder = tmp_path / "flight"
    (folder / "low" / "west").mkdir(parents=True)
    photo.rename(folder / "low" / "west" / "a.png")
    Image.new("RGB", (160, 120), (100, 100, 100)).save(folder / "low" / "b.png")
    (folder / "c.png").write_bytes(b"no picture")
    return folder


@pytest.mark.slow
def test_a_call_and_the_command_write_the_same(run, agent, flight, tmp_path, capsys):
    rows = semfov.run(flight, "red", agent=agent, recursive=True, passes=1, out=tmp_path / "call.csv")
    assert capsys.readouterr().out == ""
    code, _ = run("find", flight, "--target", "red", "--recursive", "--passes", 1, "--out", tmp_path / "command.csv")
    assert code == 1
    assert (tmp_path / "call.csv").read_text() == (tmp_path / "command.csv").read_text()
    assert ["error" in row for row in rows] == [True, False, False]
    assert [len(row.get("objects", ())) for row in rows] == [0, 0, 1]
    with (tmp_path / "call.csv").open() as file:
        assert [row["class"] for row in csv.DictReader(file)] == ["red", "red"]


def test_a_call_that_was_stopped_continues(agent, flight, tmp_path, monkeypatch):
    find_all, seen = agent.find_all, []

    def looks(picture, *arguments, **options):
        seen.append(picture)
        if len(seen) == 2:
            raise KeyboardInterrupt
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", looks)
    wanted = {"agent": agent, "recursive": True, "out": tmp_path / "found.json"}
    (flight / "c.png").unlink()
    with pytest.raises(KeyboardInterrupt):
        semfov.run(flight, "red", **wanted)
    assert len(semfov.run(flight, "red", **wanted)) == 2
    assert len(seen) == 3
    assert list(tmp_path.glob("*.unfinished")) == []


def test_only_outcomes_of_the_same_agent_are_continued(agent, flight):
    def key(one):
        return digest_of(_FindJob(FindOptions(pictures=(str(flight),), recursive=True), one).depends_on())

    before = key(agent)
    agent.find_all(flight / "low" / "b.png", "red", passes=1)
    assert key(agent) == before
    eye, strategies = agent.eye, [(each.observer, each.policy) for each in (agent.searching, agent.exploring)]
    other_cells = semfov.ActivePerception(eye, *strategies, grid=(agent.columns + 1, agent.rows))
    other_policy = semfov.ActivePerception(eye, (strategies[0][0], Policy("random")), strategies[1])
    assert len({before, key(other_cells), key(other_policy)}) == 3


def test_calls_of_several_threads_look_at_their_own_pictures(agent, flight, monkeypatch):
    find_all, rows, calls = agent.find_all, [], []

    def call():
        rows.extend(semfov.run(flight / "low", "red", agent=agent, recursive=True, passes=1))

    def looks(picture, *arguments, **options):
        if not calls:
            calls.append(threading.Thread(target=call))
            calls[0].start()
            calls[0].join(0.5)
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", looks)
    others = [flight / "other 0.png", flight / "other 1.png"]
    for path in others:
        Image.new("RGB", (96, 64), (100, 100, 100)).save(path)
    own = semfov.run(others, "red", agent=agent, passes=1)
    calls[0].join()
    assert [row["width"] for row in own] == [96, 96]
    assert [row["width"] for row in rows] == [160, 160]


def test_crops_and_labels_keep_the_places_of_their_pictures(agent, flight, tmp_path):
    (flight / "c.png").unlink()
    folders = {name: tmp_path / name for name in ("crops", "labels")}
    (_, row) = semfov.run([flight / "low"], "red", agent=agent, recursive=True, **folders)
    files = {str(path.relative_to(tmp_path)) for name in folders for path in (tmp_path / name).rglob("*.*")}
    assert files == {"labels/b.txt", "labels/west/a.txt", "crops/red/west/a-000.jpg"}
    assert (tmp_path / "labels/b.txt").read_text() == ""
    (label, *shares) = (tmp_path / "labels/west/a.txt").read_text().split()
    assert label == "0"
    (found,) = row["objects"]
    x, y, width, height = (float(share) * side for share, side in zip(shares, (160, 120) * 2, strict=True))
    torch.testing.assert_close(
        torch.tensor([x - width / 2, y - height / 2, x + width / 2, y + height / 2]),
        torch.tensor([found[name] for name in ("x1", "y1", "x2", "y2")]), rtol=0, atol=1e-3,
    )  # fmt: skip
    crop = read_image(tmp_path / "crops/red/west/a-000.jpg")
    assert crop.shape[-1] == pytest.approx(width, abs=2)
    middle = crop[:, crop.shape[1] // 2, crop.shape[2] // 2]
    torch.testing.assert_close(middle, torch.tensor([230.0, 20.0, 20.0]) / 255, rtol=0, atol=0.1)
    again = [flight / "low" / "b.png", shutil.copy(flight / "low" / "b.png", tmp_path / "b.png")]
    with pytest.raises(InputError, match=r"labels: expected pictures of different names .* got b"):
        semfov.run(again, "red", agent=agent, labels=tmp_path / "labels")


def test_crops_show_the_bands_and_the_white_of_the_look(agent, tmp_path):
    pixels = np.full((4, 120, 160), 1000, np.float32)
    pixels[1:, 8:28, 8:28] = np.array([2300, 200, 200])[:, None, None]
    tifffile.imwrite(tmp_path / "f.tif", pixels, photometric="minisblack", planarconfig="separate")
    shown = {"white": "2550", "bands": "2,3,4", "how": "fovea", "passes": 1}
    semfov.run(tmp_path / "f.tif", "red", agent=agent, crops=tmp_path / "crops", **shown)
    crop = read_image(tmp_path / "crops/red/f-000.jpg")
    middle = crop[:, crop.shape[1] // 2, crop.shape[2] // 2]
    torch.testing.assert_close(middle, torch.tensor([230.0, 20.0, 20.0]) / 255, rtol=0, atol=0.1)


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"pases": 2}, InputError, "did you mean passes="),
        ({"task": "serch"}, InputError, "did you mean 'search'"),
        ({"task": "search", "target": None}, InputError, "task='find' finds all"),
        ({"workers": 2}, InputError, "workers: expected 1 for an agent that is made already"),
        ({"detector": "yolox-nano"}, InputError, "detector: expected none beside an agent that is made already"),
        ({"pictures": []}, InputError, "pictures: expected files, folders or patterns .* got none"),
        ({"pictures": [Image.new("RGB", (8, 8))]}, InputError, "the methods of an agent take arrays .* got Image"),
        ({"target": 1}, InputError, "target: expected the name of a class"),
        ({"pictures": "no/such.png"}, DataError, "no such file or folder"),
        ({"crops": __file__}, DataError, "is not a folder"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_call_is_refused_before_the_first_look(agent, flight, options, error, said):
    wanted = {"pictures": flight / "low", "target": "red", **options}
    with pytest.raises(error, match=said):
        semfov.run(agent=agent, **wanted)


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs SIGHUP")
def test_a_terminal_that_closes_ends_a_command_in_good_order(capsys):
    cleaned = []

    def work(_):
        try:
            os.kill(os.getpid(), signal.SIGHUP)
            signal.pause()
        finally:
            cleaned.append(True)

    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # a program under nohup ignores it, and so do its children
    try:
        assert run_command(work, Settings, "", []) == 128 + signal.SIGHUP
    finally:
        signal.signal(signal.SIGHUP, before)
    assert cleaned
    assert "give the same command again" in capsys.readouterr().err
