"""Many pictures by one call of Python: what the command writes, with files of each object."""

import csv
import errno
import json
import os
import shutil
import signal
import threading
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

import semfov
from semfov import DataError, InputError, read_image, viz
from semfov.cli import outcome, written
from semfov.cli.jobs import FindJob
from semfov.cli.options import FindOptions, SearchOptions
from semfov.cli.results import held_outputs
from semfov.cli.search import _assumed_in_all
from semfov.cli.totals import expected_in_all, found_in_all
from semfov.gaze.policies import Policy
from semfov.paths import Record
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
        table = [(row["class"], bool(row["error"])) for row in csv.DictReader(file)]
    assert table == [("", True), ("red", False), ("red", False)]  # a picture that was skipped has a row, too


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


@pytest.mark.parametrize(
    ("number", "where", "name"),
    [
        (0, semfov.ActivePerception, "find_all"), (1, semfov.ActivePerception, "find_all"),
        (0, written, "write_bytes"), (1, written, "write_bytes"),
        (1, Record, "to_dict"), (1, Record, "crops"), (1, Record, "to_yolo"), (1, Record, "page_data"),
        (0, viz, "save_figure"), (1, outcome, "_outcome_text"),
    ],
    ids=lambda value: "" if isinstance(value, type | ModuleType) else str(value),
)  # fmt: skip
def test_a_fault_at_one_picture_is_a_row_with_its_reason(
    agent, folder, number, where, name, tmp_path, monkeypatch, capsys
):
    """Whatever fails at it, at the first picture or a later one, the others are written, and the code is in reach."""
    inner, doors = getattr(where, name), []
    opened = semfov.cli.sources.PictureSource.opened

    def at(source, how):
        doors.append(source.place.stem)
        return opened(source, how)

    def fails(*arguments, **options):
        if doors[-1] == "abc"[number]:
            raise KeyError("a fault of the code")
        return inner(*arguments, **options)

    monkeypatch.setattr(semfov.cli.sources.PictureSource, "opened", at)
    monkeypatch.setattr(where, name, fails)
    monkeypatch.setenv("SEMFOV_DEBUG", "1")
    wanted = {"crops": tmp_path / "crops", "labels": tmp_path / "labels", "report": tmp_path / "page.html"}
    rows = semfov.run(folder, "red", agent=agent, passes=1, out=tmp_path / "out", **wanted)
    assert [row.get("error", "").partition(": cannot be looked at ")[2] for row in rows] == [
        "(KeyError: 'a fault of the code')" * (each == number) for each in range(3)
    ]
    written = json.loads((tmp_path / "out" / "results.json").read_text())
    assert [len(written[each]) for each in ("pictures", "skipped")] == [2, 1]
    assert {path.stem for path in (tmp_path / "labels").iterdir()} >= {"abc"[each] for each in {0, 1, 2} - {number}}
    printed = capsys.readouterr().err
    assert f"skipped {folder / 'abc'[number]}.png" in printed
    assert 'raise KeyError("a fault of the code")' in printed


KNOWN_BETTER = " If you know better, give `semfov search --prior`."


@pytest.mark.parametrize(
    ("prior", "shares", "told"),
    [
        (None, (0.5, 0.5), f"The probabilities assume that half of the pictures hold it.{KNOWN_BETTER}\n"),
        (None, (0.05,), f"The probabilities assume that 5 % of the pictures hold it.{KNOWN_BETTER}\n"),
        (0.15, (0.15,), "The probabilities assume that 15 % of the pictures hold it.\n"),
        (None, (0.5, 0.1), ""),
        (None, (None,), ""),
    ],
)
def test_a_search_of_many_pictures_tells_what_its_probabilities_assume(prior, shares, told):
    rows = {number: {"assumed": share} for number, share in enumerate(shares)}
    job = SimpleNamespace(options=SearchOptions(prior=prior))
    files = SimpleNamespace(rows={**rows, 9: {"error": "unreadable"}}, job=job)
    assert _assumed_in_all(files) == told


def test_pictures_with_long_names_end_no_command(run, photo, tmp_path):
    """A crop has a longer name than its picture, and may have none."""
    names = [f"{'n' * (length - 4)}.png" for length in (200, 240, 241, 250, 251, 252, 255)]
    (tmp_path / "in").mkdir()
    for name in names:
        shutil.copy(photo, tmp_path / "in" / name)
    command = ["find", tmp_path / "in", "--target", "red", "--out", tmp_path / "out.jsonl", "--passes", 1]
    code, printed = run(*command, "--labels", tmp_path / "labels", "--crops", tmp_path / "crops")
    assert code == 1
    rows = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    skipped = [len(os.path.basename(row["picture"])) for row in rows if "error" in row]
    assert skipped == [252, 255]
    assert [len(row["objects"]) for row in rows if "error" not in row] == [1] * 5
    assert {row["error"].rpartition(": ")[2] for row in rows if "error" in row} == {os.strerror(errno.ENAMETOOLONG)}
    assert f"{len(names)} pictures: 5 looked at; 5 reds found; 2 skipped" in printed.out
    code, _ = run(*command, "--labels", tmp_path / "more")
    assert code == 0
    assert {path.stem for path in (tmp_path / "more").iterdir()} == {name.removesuffix(".png") for name in names}


def test_a_full_disk_ends_a_command_that_then_continues(agent, folder, tmp_path, monkeypatch, capsys):
    find_all, write, seen = agent.find_all, written.write_bytes, []

    def full(path, content):
        if path.endswith("b.txt"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        write(path, content)

    monkeypatch.setattr(agent, "find_all", lambda *given, **named: seen.append(given) or find_all(*given, **named))
    monkeypatch.setattr(written, "write_bytes", full)
    wanted = {"agent": agent, "passes": 1, "out": tmp_path / "found.jsonl", "labels": tmp_path / "labels"}
    with pytest.raises(DataError, match="make room, and give the same command again"):
        semfov.run(folder, "red", **wanted)
    assert "the same command continues" in capsys.readouterr().err
    monkeypatch.setattr(written, "write_bytes", write)
    rows = semfov.run(folder, "red", **wanted)
    assert ["error" in row for row in rows] == [False] * 3
    assert len(seen) == 4  # the second picture twice
    assert len((tmp_path / "found.jsonl").read_text().splitlines()) == 3


def test_a_second_command_with_the_same_output_is_refused(run, agent, folder, tmp_path, monkeypatch):
    find_all, refused = agent.find_all, []
    command = ["find", folder, "--target", "red", "--out", tmp_path / "found.jsonl", "--passes", 1]

    def looks(picture, *arguments, **options):
        monkeypatch.setattr(agent, "find_all", find_all)
        refused.append(run(*command))
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", looks)
    assert run(*command)[0] == 0
    ((code, printed),) = refused
    assert code == 1
    assert printed.err.endswith(
        f"error: cannot write {tmp_path / 'found.jsonl'}: another command is writing it; wait until it has ended, or "
        "name another\n"
    )
    assert len((tmp_path / "found.jsonl").read_text().splitlines()) == 3


def test_an_argument_that_no_picture_can_be_looked_at_with_is_refused(agent, folder, photo, monkeypatch):
    """A picture that takes no such argument is left out alone."""
    find_all = agent.find_all

    def refuses(picture, *arguments, **options):
        if not picture.endswith(last):
            raise InputError("passes: expected other ones")
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", refuses)
    last = "c.png"
    rows = semfov.run(folder, "red", agent=agent, passes=1)
    assert [row.get("error") for row in rows] == ["passes: expected other ones"] * 2 + [None]
    last = "d.png"
    with pytest.raises(InputError, match="other ones"):
        semfov.run(folder, "red", agent=agent, passes=1)


def test_only_outcomes_of_the_same_agent_are_continued(agent, flight):
    def key(one):
        return digest_of(FindJob(FindOptions(pictures=(str(flight),), recursive=True), one).depends_on())

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


def test_two_commands_cannot_make_a_folder_with_a_point_in_its_name(tmp_path):
    options = SimpleNamespace(labels=tmp_path / "labels-1.5")
    with held_outputs(options):
        options.labels.mkdir(exist_ok=True)
        with pytest.raises(DataError, match="another command is writing it"), held_outputs(options):
            pass


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


@pytest.mark.filterwarnings("always:.* left out")
def test_a_folder_is_looked_at_again_without_what_was_written_into_it(run, flight):
    """Figures, a film, crops and a page of earlier commands are no photographs of a later one."""
    (flight / "c.png").unlink()
    code, _ = run("search", flight / "low" / "west" / "a.png", "--target", "red", "--out", flight / "figures")
    assert code == 0
    assert {"scanpath.png", "animation.gif"} <= {path.name for path in (flight / "figures").iterdir()}
    tables = []
    for number in range(2):
        table = flight / f"found {number}.csv"
        outputs = ["--crops", flight / "crops", "--report", flight / "page.html", "--out", table]
        code, printed = run("find", flight, "--target", "red", "--recursive", "--passes", 1, *outputs)
        assert code == 0
        assert "pictures left out, written by semfov" in printed.err
        tables.append(table.read_text())
    assert list((flight / "crops").rglob("*.jpg"))
    assert tables[0] == tables[1]
    looked_at = {row["picture"] for row in csv.DictReader(tables[1].splitlines())}
    assert looked_at == {str(flight / "low" / name) for name in ("b.png", "west/a.png")}


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


def test_the_sum_of_what_is_expected_has_the_error_of_independent_pictures():
    def row(target, mean, error, *, guessed=False):
        numbers = {"expected": {target: mean}, "expected_error": {target: error}}
        return {"targets": [target], **numbers, "expected_guessed": {target: guessed}}

    skipped = {"picture": "c.jpg", "error": "not an image"}
    two = [row("person", 12.0, 6.0), skipped, row("person", 11.0, 8.0)]
    assert expected_in_all(two) == "expect 23 ± 10 in all"  # 6, 8, 10
    assert expected_in_all([row("person", 0.5, 0.3), row("person", 0.25, 0.4)]) == "expect 0.8 ± 0.5 in all"
    assert expected_in_all([row("person", None, None)] * 2) == ""
    assert expected_in_all([*two, row("person", None, None)]) == "expect 23 ± 10 in 2 of 3 pictures"
    of_two = "expect 23 ± 10 people in 2 of 3 pictures; expect 1.0 ± 1.0 cups in 1 of 3 pictures"
    assert expected_in_all([*two, row("cup", 1.0, 1.0)]) == of_two
    guesses = [row("person", 3.0, 24.0, guessed=True), row("person", 8.0, 7.0, guessed=True)]  # 7, 24, 25
    assert (
        expected_in_all([*two, guesses[0]])
        == "expect 23 ± 10 in 2 of 3 pictures, and at a guess 3 ± 24 in the other picture"
    )
    assert (
        expected_in_all([*two, *guesses]) == "expect 23 ± 10 in 2 of 4 pictures, and at a guess 11 ± 25 in the other 2"
    )
    assert expected_in_all(guesses) == "expect at a guess 11 ± 25 in all"


def test_a_find_of_several_classes_ends_with_the_sum_of_each():
    """Also of one of which nothing is listed, and of one whose number is known in some of the pictures alone."""

    def row(people, cups, dogs):
        numbers = {"person": people, "cup": cups, "dog": dogs}
        guessed = {"person": False, "cup": cups == 5.0, "dog": False}
        errors = {name: number and 3.0 for name, number in numbers.items()}
        objects = [{"class": "person"}] * int(people)
        return {"targets": [*numbers], "objects": objects, "expected": numbers, "expected_error": errors,
                "expected_guessed": guessed}  # fmt: skip

    rows = [row(12.0, 2.0, None), row(20.0, 5.0, 1.0)]
    people = "expect 32 ± 4 people in all"
    cups = "expect 2.0 ± 3.0 cups in 1 of 2 pictures, and at a guess 5.0 ± 3.0 in the other picture"
    dogs = "expect 1.0 ± 3.0 dogs in 1 of 2 pictures"
    assert expected_in_all(rows) == f"{people}; {cups}; {dogs}"
    job = SimpleNamespace(every=True)
    assert found_in_all(job, rows) == f"32 people, no cup, no dog found; {people}; {cups}; {dogs}"
    assert found_in_all(job, [{"picture": "c.jpg", "error": "not an image"}]) == ""
