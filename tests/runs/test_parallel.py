"""Processes: workers end with the process that started them."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}

WORK = '''
import os, sys, time
from dataclasses import dataclass
from pathlib import Path
from semfov.runs.command import run_command
from semfov.runs.settings import Settings
from semfov.runs.workers import run_tasks
from semfov.io.files import replacing

@dataclass(frozen=True)
class Config(Settings):
    """Sleep.

    Args:
        folder: where to say so.
    """
    folder: Path = Path("x")

def work(_, task):
    folder = Path(sys.argv[-1])
    with replacing(folder / f"{task}.result") as temporary:
        (folder / f"{os.getpid()}.worker").touch()
        time.sleep(600)

def main(config):
    for _ in run_tasks(
        work, [0, 1, 2], where=2, make=str, settings=(config.folder,), title="sleeping", unit="nap"
    ):
        pass

if __name__ == "__main__":
    sys.exit(run_command(main, Config, "", ["--folder", sys.argv[-1]]))
'''


def alive(number):
    try:
        state = Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@contextmanager
def running(call, **options):
    """A process that reacts to Ctrl-C as in a terminal; it is killed when the block ends."""

    def reset_interrupt():
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    options |= {"env": ENVIRONMENT, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(call, start_new_session=True, **options, **{"preexec_fn": reset_interrupt})
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_until(condition, seconds=120):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs Linux's /proc")
@pytest.mark.parametrize(
    ("number", "code", "last_line"),
    [
        (signal.SIGKILL, -9, None),
        (signal.SIGTERM, 143, "terminated; give the same command again to continue"),
        pytest.param(
            signal.SIGINT, 130, "interrupted; give the same command again to continue", marks=pytest.mark.long
        ),
    ],
    ids=["SIGKILL", "SIGTERM", "SIGINT"],
)
def test_workers_end_when_the_process_that_started_them_ends(tmp_path, number, code, last_line):
    script = tmp_path / "script.py"
    script.write_text(WORK)
    folder = tmp_path / "folder"
    folder.mkdir()
    call = [sys.executable, str(script), str(folder)]
    with running(call) as process:
        wait_until(lambda: len(list(folder.glob("*.worker"))) == 2 or process.poll() is not None)
        workers = [int(path.stem) for path in folder.glob("*.worker")]
        assert len(workers) == 2
        assert all(map(alive, workers))
        process.send_signal(number)
        error = process.communicate(timeout=60)[1]
        assert process.returncode == code, error
        assert "Traceback" not in error
        wait_until(lambda: not any(map(alive, workers)), seconds=20)
    assert [path.suffix for path in folder.iterdir()] == [".worker", ".worker"], "no unfinished file is left"
    assert last_line is None or error.strip().splitlines()[-1] == last_line


@pytest.mark.lab
@pytest.mark.parametrize("seconds", [0.25, *(pytest.param(each, marks=pytest.mark.long) for each in (0.8, 1.6))])
def test_an_early_interrupt_of_a_study_prints_no_traceback(tmp_path, seconds):
    call = [sys.executable, "-m", "eval.search", "--out", str(tmp_path), "--workers", "2"]
    with running(call, cwd=ROOT) as process:
        # Before torch is loaded, Python may not have started to import the module.
        wait_until(lambda: "torch" in Path(f"/proc/{process.pid}/maps").read_text() or process.poll() is not None)
        time.sleep(seconds)
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=60)[1]
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert "interrupted" in error.splitlines()[-1]


@pytest.mark.slow
@pytest.mark.weights
def test_a_closed_output_pipe_prints_no_traceback():
    """As in `semfov detectors | head -0`."""
    call = [sys.executable, "-m", "semfov", "detectors"]
    with running(call, cwd=ROOT, stdout=subprocess.PIPE) as process:
        process.stdout.close()
        process.stdout = None
        error = process.communicate(timeout=120)[1]
        assert process.returncode == 141, error
        assert error == ""
