"""Atomic writes: what is left of a write that does not finish."""

import errno
import os
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path

import pytest

from semfov.errors import DataError
from semfov.io.files import discard_unfinished, disk_is_full, replacing, write_bytes, written_alone
from semfov.io.pretrained import Pretrained, fit_command


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


@pytest.mark.skipif(os.name != "posix", reason="needs the permissions of POSIX")
def test_a_file_keeps_its_permissions_and_a_new_one_has_those_of_the_umask(tmp_path):
    private = tmp_path / "private.csv"
    private.write_text("old")
    private.chmod(0o640)
    write_bytes(private, b"new")
    assert private.stat().st_mode & 0o777 == 0o640
    for umask in (0o077, 0o022, 0o002):
        before = os.umask(umask)
        try:
            write_bytes(tmp_path / f"{umask}.csv", b"new")
            (tmp_path / f"{umask}.txt").write_text("as other programs write it")
        finally:
            os.umask(before)
        assert (tmp_path / f"{umask}.csv").stat().st_mode == (tmp_path / f"{umask}.txt").stat().st_mode


@pytest.mark.skipif(os.name != "posix", reason="needs symbolic links")
def test_behind_a_link_the_file_is_written_that_it_points_to(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target = tmp_path / "elsewhere" / "target.csv"
    link = tmp_path / "link.csv"
    link.symlink_to("elsewhere/target.csv")
    for content in (b"first", b"second"):  # before it exists, and when it does
        write_bytes(link, content)
        assert link.is_symlink()
        assert target.read_bytes() == content
    second = tmp_path / "second.csv"
    second.symlink_to(link)
    write_bytes(second, b"third")
    assert (link.is_symlink(), second.is_symlink(), target.read_bytes()) == (True, True, b"third")
    circle = tmp_path / "circle.csv"
    circle.symlink_to(circle)
    with pytest.raises(DataError, match=r"cannot write .*circle\.csv"):
        write_bytes(circle, b"")
    assert circle.is_symlink()
    assert [path.name for path in tmp_path.rglob("*.part")] == []


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


def chain(*errors):
    """Errors, each caused by the next one; the first."""
    for error, cause in pairwise(errors):
        error.__cause__ = cause
    return errors[0]


def test_a_full_disk_is_found_behind_any_number_of_causes():
    full = OSError(errno.ENOSPC, "no space left")
    for error in (full, chain(DataError("a"), full), chain(DataError("a"), DataError("b"), ValueError("c"), full)):
        assert disk_is_full(error)
    assert disk_is_full(chain(OSError(errno.EACCES, "denied"), OSError(errno.EDQUOT, "quota")))
    assert disk_is_full(chain(full, DataError("a")))
    circle = DataError("a")
    for error in (DataError("a"), chain(DataError("a"), OSError(errno.EACCES, "denied")), chain(circle, circle)):
        assert not disk_is_full(error)


def test_a_full_disk_is_found_in_an_error_of_a_database():
    database = sqlite3.connect(":memory:")
    database.execute("PRAGMA max_page_count = 2")
    with closing(database), pytest.raises(sqlite3.OperationalError, match="full") as caught:
        database.execute("CREATE TABLE pages AS SELECT randomblob(100000)")
    assert disk_is_full(chain(DataError("cannot write"), caught.value))
    with pytest.raises(sqlite3.OperationalError) as other, closing(sqlite3.connect(":memory:")) as database:
        database.execute("SELECT * FROM pages")
    assert not disk_is_full(chain(DataError("cannot read"), other.value))


def test_a_command_quotes_names_of_files():
    assert fit_command("my models/a.onnx", out="$x") == (f"semfov fit 'my models/a.onnx' {Pretrained.data} --out '$x'")
    assert fit_command("yolox-nano") == f"semfov fit yolox-nano {Pretrained.data} --out mymodels"
