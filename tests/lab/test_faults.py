"""Kills, full disks, damaged and shared files: the error has one line, and the next run gives the same result."""

import errno
import json
import os
import resource
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
SEARCH = [
    sys.executable, "-m", "eval.search", "--data.limit", "2", "--belief.columns", "3", "--belief.rows", "2",
    "--protocol.starts", "2", "--protocol.shifts", "4", "--policies", '["non-predictive-raw"]', "--scanpaths", "0",
]  # fmt: skip
RESULTS = ("episodes.jsonl", "summary.csv")

pytestmark = pytest.mark.slow


def start(out: Path, cache: Path, *more: str, **options: Any) -> subprocess.Popen[str]:
    """Start a small search in a new session."""
    call = [*SEARCH, "--out", str(out), "--cache", str(cache), *more]
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(call, cwd=ROOT, env=environment, start_new_session=True, **pipes, **options)


def wait_for_end(process: subprocess.Popen[str], code: int) -> str:
    """Check that the process ends with this exit code and without a traceback; return the last line of its errors."""
    error = process.communicate(timeout=300)[1]
    assert process.returncode == code, error
    assert "Traceback" not in error
    return error.strip().splitlines()[-1] if code else ""


def result_files(out: Path) -> list[bytes]:
    return [(out / name).read_bytes() for name in RESULTS]


def wait_for(found: Callable[[], Any]) -> Any:
    deadline = time.monotonic() + 300
    while not (found_value := found()):
        assert time.monotonic() < deadline, "the condition was not met within 300 s"
        time.sleep(0.005)
    return found_value


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Worker processes of a run."""
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    commands = {int(child): Path(f"/proc/{child}/cmdline") for child in children}
    return [child for child, command in commands.items() if b"spawn_main" in command.read_bytes()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A folder with `out` and `cache` of a small search that ran without faults."""
    folder = tmp_path_factory.mktemp("whole")
    assert run_here(folder) == 0
    return folder


@pytest.mark.long
@pytest.mark.parametrize("command", ["store", "evaluation", "fit", "workers", "reports"])
def test_killed_runs_resume_with_results_equal_to_the_bit(command, tmp_path):
    figures = tmp_path / "figures.json"
    call = [sys.executable, "-m", "benchmarks.faults", "--only", command, "--kills", "3", "--json", str(figures)]
    subprocess.run(call, cwd=ROOT, check=True, capture_output=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    figures_of_command = json.loads(figures.read_text())[command]
    assert len(figures_of_command["progress"]) == figures_of_command["identical"] == 3
    assert figures_of_command["left"] == 0


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs Linux's /proc")
def test_a_run_finishes_after_a_killed_worker_a_full_disk_and_an_interrupt(whole, tmp_path):
    """One worker is killed, the second run has a full disk, the third is interrupted, and the last one finishes."""
    out, cache = tmp_path / "out", tmp_path / "cache"
    process = start(out, cache, "--workers", "2")
    os.kill(wait_for(partial(workers_of, process))[-1], signal.SIGKILL)
    assert "a worker process died" in wait_for_end(process, 1)

    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (2000, 2000))
    message = wait_for_end(start(out, cache, "--workers", "1", preexec_fn=limit), 1)
    assert message.startswith("error: cannot write")
    assert str(cache) in message

    process = start(out, cache, "--workers", "2")
    workers = wait_for(partial(workers_of, process))
    wait_for(lambda: list(tmp_path.rglob("*.safetensors")))
    os.killpg(process.pid, signal.SIGINT)
    assert "interrupted" in wait_for_end(process, 130)
    wait_for(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers))

    wait_for_end(start(out, cache, "--workers", "2"), 0)
    assert result_files(out) == result_files(whole / "out")
    assert not list(tmp_path.rglob("*.part"))


def test_two_processes_can_share_a_cache(whole, tmp_path):
    together = [start(tmp_path / name, tmp_path / "cache", "--workers", "1") for name in ("first", "second")]
    for process in together:
        wait_for_end(process, 0)
    assert result_files(tmp_path / "first") == result_files(tmp_path / "second") == result_files(whole / "out")
    assert not list(tmp_path.rglob("*.part"))


@pytest.mark.parametrize("full", ["cache", "out"])
def test_a_run_goes_on_after_a_write_without_space(whole, tmp_path, monkeypatch, capsys, full):
    """Without space the error names the file in one line; with space the same command finishes."""
    from semfov.io import files

    out, cache, replace = tmp_path / "out", tmp_path / "cache", files.Path.replace
    filled = out if full == "out" else cache

    def no_space(path, target):
        if Path(target).is_relative_to(filled):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return replace(path, target)

    monkeypatch.setattr(files.Path, "replace", no_space)
    assert run_in(out, cache) == 1
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith(f"error: cannot write {filled}")
    assert error.endswith("No space left on device")
    assert not list(tmp_path.rglob("*.part"))
    monkeypatch.undo()
    assert run_in(out, cache) == 0
    assert result_files(out) == result_files(whole / "out")


def test_damaged_and_swapped_files_are_computed_again(whole, tmp_path):
    """Stored looks and outcomes of scenes are swapped, cut, or changed by one bit; the results stay the same."""
    looks = sorted((whole / "cache" / "looks").rglob("*.safetensors"))
    (part,) = (whole / "out" / "parts").rglob("*.sqlite")
    assert len(looks) == 2
    kept = {file: file.read_bytes() for file in (*looks, part)}
    expected = result_files(whole / "out")
    for damage in ("swapped", "cut", "flipped"):
        for file, other in zip(looks, reversed(looks), strict=True):
            file.write_bytes(damaged(kept[other if damage == "swapped" else file], damage, -100))
        part.unlink()
        before = {file: file.read_bytes() for file in looks}
        assert run_here(whole) == 0
        assert result_files(whole / "out") == expected, damage
        assert all(file.read_bytes() != before[file] for file in looks)
    for damage in ("swapped", "cut", "flipped"):
        place = kept[part].index(b'"cells"') + 1
        part.write_bytes(damaged(kept[part], damage, place))
        if damage == "swapped":
            with closing(sqlite3.connect(part)) as database, database:
                database.execute("UPDATE scenes SET number = 9 - number")
                database.execute("UPDATE scenes SET number = number - 8")
        assert run_here(whole) == 0
        assert result_files(whole / "out") == expected, damage


def damaged(content: bytes, damage: str, place: int) -> bytes:
    """Content that is cut, or changed by one bit."""
    changed = bytearray(content)
    changed[place] ^= 4 if damage == "flipped" else 0
    return bytes(changed[: len(changed) // 2] if damage == "cut" else changed)


def run_here(folder: Path) -> int:
    """Run the small search in this process."""
    return run_in(folder / "out", folder / "cache")


def run_in(out: Path, cache: Path) -> int:
    """Run the small search in this process, in the given folders."""
    from eval.search import main

    return main([*SEARCH[3:], "--out", str(out), "--cache", str(cache), "--workers", "1"])
