"""Runs that are killed at a random moment and started again: is the result the same to the last bit?

A command is started on the embedded scenes, killed (SIGKILL) after a random share of the time that a whole run takes,
and started again; what it leaves is compared with what a run leaves that nobody disturbs:

- `store`: `eval.search` from the first look: what is seen from every cell is kept in a store;
- `evaluation`: `eval.explore` with its store there, while it runs policies and writes its report;
- `fit`: `train.fit_fom` from the first look to the fitted model;
- `workers`: `store` with two worker processes;
- `reports`: `evaluation` with all its outcomes there, while it writes its report.

After each kill no process of the run may be left. Runs are forked from one process that has imported everything, so
that kills hit work and not the start of Python. A run that was faster than its kill does not count; the next is given
another moment.

python -m benchmarks.faults --kills 50
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot  # noqa: F401 (imported once for all forks)
import torch
from safetensors import safe_open

from eval.explore import main as explore
from eval.search import main as search
from semfov.io.storage import checksum
from train.fit_fom import main as fit

Main = Callable[[Sequence[str]], int]

_SMALL = [
    "--workers", "1", "--data.limit", "2", "--belief.columns", "3", "--belief.rows", "2",
    "--protocol.starts", "2", "--protocol.shifts", "4",
]  # fmt: skip
_SEARCH = [*_SMALL, "--scanpaths", "0", "--policies", '["random", "non-predictive-raw"]']
_EXPLORE = [*_SMALL, "--policies", '["random-raw", "kl-calibrated"]']
_FIT = [
    "--workers", "1", "--data.limit", "4", "--fixations", "1", "--holdout", "3", "--shard", "1", "--method", "newton",
]  # fmt: skip


def _two(arguments: list[str]) -> list[str]:
    """The arguments with two workers."""
    return [*arguments, "--workers", "2"]


@dataclass(frozen=True)
class Command:
    """A command and what it must leave.

    Attributes:
        name: in tables.
        main: the command.
        arguments: without folders.
        results: files of `out` that must be the same to the last bit.
        stored: whether the store is there already.
        finished: whether the outcomes are there already, too.
    """

    name: str
    main: Main
    arguments: tuple[str, ...]
    results: tuple[str, ...]
    stored: bool = False
    finished: bool = False

    def run(self, folder: Path) -> None:
        """Run in this process, in silence; it does not return."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        torch.set_num_threads(1)
        arguments = [*self.arguments, "--out", str(folder / "out"), "--cache", str(folder / "cache")]
        os._exit(self.main(arguments))

    def digest(self, folder: Path) -> str:
        """sha256 over the results, and over what the caches hold."""
        digest = hashlib.sha256()
        for name in self.results:
            digest.update((folder / "out" / name).read_bytes())
        for file in sorted((folder / "cache").rglob("*.safetensors")):
            with safe_open(file, framework="pt") as tensors:
                digest.update(checksum({key: tensors.get_tensor(key) for key in tensors.keys()}).encode())  # noqa: SIM118
            digest.update(file.relative_to(folder).as_posix().encode())
        return digest.hexdigest()


_RECORDS = ("episodes.jsonl", "summary.csv")
COMMANDS = (
    Command("store", search, tuple(_SEARCH), (*_RECORDS, "cumulative_performance.png")),
    Command("evaluation", explore, tuple(_EXPLORE), (*_RECORDS, "success_rate_all_classes.png"), stored=True),
    Command("fit", fit, tuple(_FIT), ("yolov3-tiny.safetensors", "report.md", "counts.csv")),
    Command("workers", search, tuple(_two(_SEARCH)), _RECORDS),
    Command("reports", explore, tuple(_EXPLORE), (*_RECORDS, "report.html"), stored=True, finished=True),
)


@dataclass(frozen=True)
class Survived:
    """What came of the kills of a command.

    Attributes:
        seconds: of an undisturbed run.
        spared: runs that ended before their kill.
        progress: for each kill, files that were there, finished.
        remains: for each kill, unfinished files that were left behind.
        identical: kills after which the result is that of the undisturbed run.
        left: processes of killed runs that were still there ten seconds later.
    """

    seconds: float
    spared: int
    progress: list[int]
    remains: list[int]
    identical: int
    left: int


def survive(command: Command, kills: int, seed: int = 0) -> Survived:
    """Kill and resume a command so often."""
    fork = multiprocessing.get_context("fork")
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole, cache, here = folder / "whole", folder / "looks", folder / "killed"
        cache.mkdir()
        if command.stored:
            finish(fork.Process(target=command.run, args=(whole,)))
            (whole / "cache").rename(cache / "cache")
            if command.finished:
                (cache / "out").mkdir()
                (whole / "out" / "parts").rename(cache / "out" / "parts")
            shutil.rmtree(whole)
        shutil.copytree(cache, whole)
        seconds = finish(fork.Process(target=command.run, args=(whole,)))
        expected = command.digest(whole)
        spared, identical, left = 0, 0, 0
        progress: list[int] = []
        remains: list[int] = []
        while len(progress) < kills:
            shutil.copytree(cache, here)
            process = fork.Process(target=command.run, args=(here,))
            process.start()
            process.join(chance.random() * seconds)
            children = descendants(process.pid or 0)
            process.kill()
            process.join()
            left += still_there(children)
            if process.exitcode == -signal.SIGKILL:
                files = [file for file in here.rglob("*") if file.is_file()]
                parts = sum(file.suffix == ".part" for file in files)
                progress.append(len(files) - parts)
                remains.append(parts)
                finish(fork.Process(target=command.run, args=(here,)))
                identical += command.digest(here) == expected
            else:
                spared += 1
            shutil.rmtree(here)
    return Survived(seconds, spared, progress, remains, identical, left)


def descendants(number: int) -> list[int]:
    """Processes that a process started, and those that they did (on Linux; elsewhere none are known)."""
    found: list[int] = []
    for path in Path("/proc").glob(f"{number}/task/*/children"):
        with suppress(OSError):
            for child in map(int, path.read_text().split()):
                found += [child, *descendants(child)]
    return found


def still_there(numbers: list[int], seconds: float = 10.0) -> int:
    """How many of these processes do not end within some time."""
    deadline = time.monotonic() + seconds
    while (alive := [number for number in numbers if _alive(number)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    return len(alive)


def _alive(number: int) -> bool:
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def finish(process: "multiprocessing.context.ForkProcess") -> float:
    """Run a process to its end; returns seconds."""
    start = time.perf_counter()
    process.start()
    process.join()
    if process.exitcode != 0:
        raise RuntimeError(f"a run that nobody disturbed ended with exit code {process.exitcode}")
    return time.perf_counter() - start


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="of each command")
    parser.add_argument("--only", nargs="+", choices=[c.name for c in COMMANDS], help="these commands; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures here too")
    options = parser.parse_args()
    print("| run | s | kills | finished files then | unfinished | processes left | same bits after |")
    print("|---|---|---|---|---|---|---|", flush=True)
    figures = {}
    for command in [c for c in COMMANDS if options.only is None or c.name in options.only]:
        came = survive(command, options.kills, options.seed)
        figures[command.name] = came.__dict__
        files = f"{min(came.progress)} to {max(came.progress)}"
        cells = [f"{came.seconds:.1f}", options.kills, files, sum(came.remains), came.left, came.identical]
        print(f"| {command.name} | {' | '.join(map(str, cells))} |", flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
