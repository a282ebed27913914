"""Atomic writes: what is left of a write that does not finish."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from semfov.errors import DataError
from semfov.io.files import discard_unfinished, replacing, write_bytes, written_alone


def test_a_process_that_ends_while_the_temporary_file_is_created_leaves_nothing(tmp_path, monkeypatch):
    touch = Path.touch

    def ended(path, *arguments, **options):
        touch(path, *arguments, **options)
        discard_unfinished()  # as a handler of a signal does before the process ends
        raise SystemExit

    monkeypatch.setattr(Path, "touch", ended)
    with pytest.raises(SystemExit), replacing(tmp_path / "a.json"):
        pass
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_ends_within_a_write_leaves_the_old_file_alone(tmp_path):
    path = tmp_path / "a.json"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == tmp_path
        assert temporary.stat().st_mode & 0o077 == 0
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    with pytest.raises(ValueError, match="invalid literal"), replacing(path):
        int("x")
    assert [each.name for each in tmp_path.iterdir()] == ["a.json"]
    assert path.read_text() == "new"


def test_paths_that_name_no_file_are_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match=r"cannot write .*a\.json"), replacing(tmp_path / "file" / "a.json"):
        pass
    for path in ("", "."):
        with pytest.raises(DataError, match=r"cannot write '.': expected the name of a file"), replacing(path):
            pass


def test_parts_of_writers_that_were_killed_are_removed_when_they_are_old(tmp_path):
    names = [".a.json.0123abcd.part", ".b.json.00000000.part", "c.part", ".d.0123abcd.part.txt"]
    for name in names:
        (tmp_path / name).write_text("")
    day = 24 * 3600
    for name in (names[0], names[2], names[3]):
        os.utime(tmp_path / name, (time.time() - 2 * day,) * 2)
    write_bytes(tmp_path / "new.json", b"")
    assert {each.name for each in tmp_path.iterdir()} == {*names[1:], "new.json"}


@pytest.mark.parametrize("length", [2, 100, 240, 241, 251, 255])
def test_a_name_may_be_as_long_as_the_file_system_allows(length, tmp_path):
    for letter in ("a", "é"):
        path = tmp_path / (letter * (length // len(letter.encode())))
        write_bytes(path, b"x")
        assert path.read_bytes() == b"x"
        with written_alone([path]):
            pass


def test_what_a_process_writes_is_refused_to_others_until_it_ends_in_any_way(tmp_path):
    """The first is killed, so that it cannot clean up behind itself."""
    hold = (
        "import sys, time; from pathlib import Path; from semfov.io.files import written_alone\n"
        "with written_alone([Path(sys.argv[1])], [Path(sys.argv[2])]): print('held', flush=True); time.sleep(600)"
    )
    file, folder = tmp_path / "a.jsonl", tmp_path / "crops"
    with subprocess.Popen([sys.executable, "-c", hold, file, folder], stdout=subprocess.PIPE, text=True) as first:
        assert first.stdout.readline() == "held\n"
        for files, folders in (([file], []), ([tmp_path / "b.json"], [folder])):
            with pytest.raises(DataError, match="another command is writing it"), written_alone(files, folders):
                pass
        with written_alone([tmp_path / "b.json"], [tmp_path / "labels"]):
            pass
        first.kill()
    with written_alone([file], [folder]):
        pass
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["crops", "labels"]
