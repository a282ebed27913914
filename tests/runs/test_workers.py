"""Work that is shared by processes of this machine, or by those of a cluster."""

import io
import multiprocessing
import operator
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path

import pytest
import torch
from tqdm import tqdm

from semfov.errors import InputError, SemfovError
from semfov.runs import workers
from semfov.runs.config import BeliefConfig, DataConfig, LookingConfig
from semfov.runs.looking import Looking
from semfov.runs.scene_run import finish
from semfov.runs.workers import run_tasks, shared_processes
from tests.refusals import refused

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
        work, range(20), where=2, make=str, settings=(config.folder,), title="sleeping", unit="nap"
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
def test_a_closed_output_pipe_prints_no_traceback():
    """As in `semfov detectors | head -0`."""
    call = [sys.executable, "-m", "semfov", "detectors"]
    with running(call, cwd=ROOT, stdout=subprocess.PIPE) as process:
        process.stdout.close()
        process.stdout = None
        error = process.communicate(timeout=120)[1]
        assert process.returncode == 141, error
        assert error == ""


TASKS = """
import os, time
from functools import partial
from pathlib import Path

made = []

def make(value):
    assert not made, "made twice"
    made.append(value)
    return value

def work(offset, task):
    number, folder, seconds = task
    Path(folder, f"{os.getpid()}.worker").touch()
    time.sleep(seconds)
    return number ** 2 + offset
"""


def of_task(function, _, task):
    return function(task)


def results(function, tasks, where, *, make=id, settings=(0,)):
    one = partial(of_task, function)
    run = run_tasks(one, tasks, where=where, make=make, settings=settings, title="testing", unit="task")
    return dict(run)


@pytest.mark.parametrize("where", [1, 2])
def test_a_bar_counts_the_units_of_tasks(where, monkeypatch):
    bars = []

    def bar(total, title, unit, *, hidden):
        bars.append(tqdm(total=total, unit=unit, disable=False, file=io.StringIO()))
        return bars[-1]

    monkeypatch.setattr(workers, "task_bar", bar)
    names = ["a", "bb", "cccc"]
    work = run_tasks(str.__add__, names, where=where, make=str, settings=("x",), title="", unit="letter", count=len)
    assert dict(work) == {name: f"x{name}" for name in names}
    assert [(each.total, each.n, each.unit) for each in bars] == [(7, 7, "letter")]


class Waiting(Executor):
    """Keeps tasks until it is asked to run one."""

    def __init__(self):
        self.kept, self.most = [], 0

    def submit(self, function, *arguments):
        future = Future()
        self.kept.append((future, function, arguments))
        self.most = max(self.most, len(self.kept))
        if len(self.kept) == workers._OUTSTANDING or arguments[0] >= 998:
            self.run()
        return future

    def run(self):
        def finish(kept):
            for future, function, arguments in kept:
                future.set_result(function(*arguments))

        threading.Timer(0.01, finish, [self.kept]).start()
        self.kept = []


def test_threads_of_a_worker_take_turns():
    busy = []

    def work(task):
        busy.append(task)
        time.sleep(0.002)
        assert busy == [task]
        return busy.pop()

    with ThreadPoolExecutor(4) as pool:
        assert results(work, range(20), pool) == {n: n for n in range(20)}


def test_any_executor_gives_what_one_process_gives():
    expected = {-n: n for n in range(50)}
    assert results(operator.neg, [-n for n in range(50)], 1) == expected
    with ThreadPoolExecutor(4) as pool:
        assert results(operator.neg, [-n for n in range(50)], pool) == expected
        assert pool.submit(int).result() == 0, "an executor that was given stays open"
    pool = Waiting()
    assert results(operator.neg, range(1000), pool) == {n: -n for n in range(1000)}
    assert pool.most == workers._OUTSTANDING


def test_a_process_is_prepared_again_for_other_settings():
    seen = []
    with ThreadPoolExecutor(1) as pool:
        for settings in ((1,), (1,), (2,)):
            results(operator.neg, [5], pool, make=seen.append, settings=settings)
            results(operator.neg, [6], pool, make=seen.append, settings=settings)
    assert seen == [1, 2]


def test_an_error_of_a_task_is_raised_unchanged_and_the_others_are_cancelled():
    with ThreadPoolExecutor(1) as pool, pytest.raises(ZeroDivisionError):
        results((1).__truediv__, [0, *range(1, 200)], pool)


def test_workers_of_another_version_are_refused(monkeypatch):
    digests = iter(["here", "there"])
    monkeypatch.setattr(workers, "package_digest", lambda: next(digests))
    with ThreadPoolExecutor(1) as pool, pytest.raises(SemfovError, match="another version of semfov"):
        results(operator.neg, [1, 2], pool)


SETTING = []


def set_to(value):
    SETTING[:] = [value]


def process_and_setting(_):
    return os.getpid(), *SETTING


def with_setting(value):
    return results(process_and_setting, range(4), 2, make=set_to, settings=(value,))


@pytest.mark.slow
def test_shared_processes_stay_for_other_settings_and_end_with_the_block():
    with shared_processes():
        first, second = with_setting("one"), with_setting("two")
        kept = {child.pid for child in multiprocessing.active_children()}
    assert {setting for _, setting in first.values()} == {"one"}
    assert {setting for _, setting in second.values()} == {"two"}
    used = {process for process, _ in [*first.values(), *second.values()]}
    assert used <= kept
    assert len(kept) == 2
    assert os.getpid() not in used
    assert multiprocessing.active_children() == []


@pytest.mark.lab
def test_shared_processes_end_at_once_if_the_block_fails():
    with pytest.raises(ZeroDivisionError), shared_processes():  # noqa: PT012
        results((1).__truediv__, [1, 2, 3], 2)
        assert len(multiprocessing.active_children()) == 2
        results((1).__truediv__, [0, 1, 2], 2)
    assert multiprocessing.active_children() == []


def free_port():
    with socket.socket() as some:
        some.bind(("127.0.0.1", 0))
        return some.getsockname()[1]


@contextmanager
def process(*arguments, path, cache=None):
    """A command of Dask; it is killed when the block ends."""
    pytest.importorskip("distributed")
    environment = {**os.environ, "PYTHONPATH": f"{path}:{ROOT}", "OMP_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    environment |= {} if cache is None else {"XDG_CACHE_HOME": str(cache)}
    call = [sys.executable, "-c", "from dask.__main__ import main; main()", *arguments]
    one = subprocess.Popen(
        call, env=environment, cwd="/", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )
    try:
        yield one
    finally:
        one.send_signal(signal.SIGKILL)
        one.wait()


def scheduler(port, path):
    return process("scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard", path=path)


def worker(port, path, cache=None):
    own = ("--nthreads", "1", "--no-nanny", "--no-dashboard", "--local-directory", str(path))
    return process("worker", f"tcp://127.0.0.1:{port}", *own, path=path, cache=cache)


@pytest.fixture
def tasks(tmp_path, monkeypatch):
    (tmp_path / "cluster_tasks.py").write_text(TASKS)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(workers, "_REACH", 60.0)
    import cluster_tasks

    yield cluster_tasks
    del sys.modules["cluster_tasks"]


@pytest.mark.slow
@pytest.mark.lab
@pytest.mark.filterwarnings("ignore")
def test_a_cluster_that_loses_a_worker_and_its_scheduler_gives_what_one_process_gives(tasks, tmp_path):
    port = free_port()
    todo = [(n, str(tmp_path), 0.1) for n in range(40)]
    got = {}
    with ExitStack() as stack:
        first = stack.enter_context(scheduler(port, tmp_path))
        both = [stack.enter_context(worker(port, tmp_path)) for _ in range(2)]
        address = f"tcp://127.0.0.1:{port}"
        run = run_tasks(tasks.work, todo, where=address, make=tasks.make, settings=(7,), title="testing", unit="task")
        for task, result in run:
            assert task not in got
            got[task] = result
            if len(got) == 6:
                both[0].send_signal(signal.SIGKILL)
            if len(got) == 12:
                first.send_signal(signal.SIGKILL)
                first.wait()
                stack.enter_context(scheduler(port, tmp_path))
                stack.enter_context(worker(port, tmp_path))
    assert got == {task: task[0] ** 2 + 7 for task in todo}
    assert f"{os.getpid()}.worker" not in {path.name for path in tmp_path.glob("*.worker")}


@pytest.mark.slow
@pytest.mark.lab
@pytest.mark.filterwarnings("ignore")
def test_looks_of_a_cluster_come_back_and_are_the_same_to_the_bit(tmp_path, monkeypatch):
    """The worker has another cache, which this process does not read."""
    port = free_port()
    looked = {}
    with scheduler(port, tmp_path), worker(port, tmp_path, cache=tmp_path / "far"):
        for name, where in (("alone", {"workers": 1}), ("near", {"scheduler": f"tcp://127.0.0.1:{port}"})):
            monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / name))
            config = LookingConfig(
                data=DataConfig(limit=2),
                belief=BeliefConfig(columns=2, rows=1),
                out=tmp_path / name,
                **where,
            )
            run = Looking(config)
            finish(run, "looking")
            looked[name] = [run.store.read(run.digest(index)) for index in range(2)]
    assert (tmp_path / "far").is_dir()
    for alone, near in zip(looked["alone"], looked["near"], strict=True):
        assert alone.keys() == near.keys()
        assert all(torch.equal(alone[name], near[name]) for name in alone)


def test_without_a_scheduler_the_error_says_what_to_start(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(workers, "_REACH", 0.2)
    with pytest.raises(InputError, match="expected the address of a running Dask scheduler"):
        results(operator.neg, [1, 2], f"tcp://127.0.0.1:{free_port()}")
    refused("expected the address of a running Dask scheduler", results, operator.neg, [1, 2], "nowhere")
