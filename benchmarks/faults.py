"""Are the results of runs that are killed at a random moment and restarted the same to the last bit?

A command is started on the embedded scenes, killed (SIGKILL) after a random share of the duration of a whole run, and
started again. Its output is compared with that of an undisturbed run:

- `store`: `eval.search` from the first look on, while it stores the detections from every cell;
- `evaluation`: `eval.explore` with a complete store, while it runs policies and writes its report;
- `fit`: `train.fit_fom` from the first look to the fitted model;
- `workers`: `store` with two worker processes;
- `reports`: `evaluation` with all outcomes complete, while it writes its report.

After each kill, no process of the run may remain. Runs are forked from one process that has imported everything, so
that kills hit the work and not the start of Python. A run that ends before its kill does not count; the next run is
killed at another moment.

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

from benchmarks.tables import table
from eval.explore import main as explore
from eval.search import main as search
from semfov.io.storage import checksum
from train.fit_fom import main as fit

Main = Callable[[Sequence[str]], int]

_ALONE = ("--workers", "1")
_SMALL = [
    "--data.limit", "2", "--belief.columns", "3", "--belief.rows", "2",
    "--protocol.starts", "2", "--protocol.shifts", "4",
]  # fmt: skip
_SEARCH = [*_SMALL, "--scanpaths", "0", "--policies", '["random", "non-predictive-raw"]']
_EXPLORE = [*_SMALL, "--policies", '["random-raw", "kl-calibrated"]']
_FIT = [
    *_ALONE, "--data.limit", "4", "--fixations", "1", "--holdout", "3", "--shard", "1", "--method", "newton",
]  # fmt: skip


@dataclass(frozen=True)
class Command:
    """A command and the files that it must write.

    Attributes:
        name: name in tables.
        main: function of the command.
        arguments: arguments without folders.
        results: files of `out` that must be the same to the last bit.
        stored: whether the store is complete at the start.
        finished: whether the outcomes are complete at the start, too.
    """

    name: str
    main: Main
    arguments: tuple[str, ...]
    results: tuple[str, ...]
    stored: bool = False
    finished: bool = False

    def run(self, folder: Path) -> None:
        """Run in this process without output, and end the process."""
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        torch.set_num_threads(1)
        arguments = [*self.arguments, "--out", str(folder / "out"), "--cache", str(folder / "cache")]
        os._exit(self.main(arguments))

    def digest(self, folder: Path) -> str:
        """Return the sha256 of the results and of the contents of the caches."""
        digest = hashlib.sha256()
        for name in self.results:
            digest.update((folder / "out" / name).read_bytes())
        for file in sorted((folder / "cache").rglob("*.safetensors")):
            with safe_open(file, framework="pt") as tensors:
                digest.update(checksum({key: tensors.get_tensor(key) for key in tensors.keys()}).encode())  # noqa: SIM118
            digest.update(file.relative_to(folder).as_posix().encode())
        return digest.hexdigest()


HEAD = ("run", "s", "kills", "finished files", "unfinished files", "processes left", "same bits after restart")
_RECORDS = ("episodes.jsonl", "summary.csv")
COMMANDS = (
    Command("store", search, (*_ALONE, *_SEARCH), (*_RECORDS, "cumulative_performance.png")),
    Command("evaluation", explore, (*_ALONE, *_EXPLORE), (*_RECORDS, "success_rate_all_classes.png"), stored=True),
    Command("fit", fit, tuple(_FIT), ("yolox-nano.safetensors", "report.md", "counts.csv")),
    Command("workers", search, (*_SEARCH, "--workers", "2"), _RECORDS),
    Command("reports", explore, (*_ALONE, *_EXPLORE), (*_RECORDS, "report.html"), stored=True, finished=True),
)


@dataclass(frozen=True)
class Survived:
    """Results of the kills of a command.

    Attributes:
        seconds: duration of an undisturbed run.
        progress: for each kill, number of finished files at that moment.
        remains: for each kill, number of unfinished files left behind.
        identical: number of kills after which the restarted run has the same result as the undisturbed run.
        left: number of processes of killed runs that still existed ten seconds later.
    """

    seconds: float
    progress: list[int]
    remains: list[int]
    identical: int
    left: int


def survive(command: Command, kills: int, seed: int = 0) -> Survived:
    """Kill and restart a command `kills` times."""
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
        identical, left = 0, 0
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
                unfinished = sum(file.suffix == ".part" for file in files)
                progress.append(len(files) - unfinished)
                remains.append(unfinished)
                finish(fork.Process(target=command.run, args=(here,)))
                identical += command.digest(here) == expected
            shutil.rmtree(here)
    return Survived(seconds, progress, remains, identical, left)


def descendants(number: int) -> list[int]:
    """All descendants of a process (on Linux; empty on other systems)."""
    numbers: list[int] = []
    for path in Path("/proc").glob(f"{number}/task/*/children"):
        with suppress(OSError):
            for child in map(int, path.read_text().split()):
                numbers += [child, *descendants(child)]
    return numbers


def still_there(numbers: list[int], seconds: float = 10.0) -> int:
    """Count the processes that do not end within some seconds."""
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
    """Run a process to its end; returns its duration in seconds."""
    start = time.perf_counter()
    process.start()
    process.join()
    if process.exitcode != 0:
        raise RuntimeError(f"expected exit code 0 of an undisturbed run, got {process.exitcode}")
    return time.perf_counter() - start


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50, help="number of kills of each command")
    parser.add_argument("--only", nargs="+", choices=[c.name for c in COMMANDS], help="commands to test (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the moments of the kills")
    parser.add_argument("--json", type=Path, help="JSON file to write the results to, too")
    options = parser.parse_args()
    rows, figures = [], {}
    for command in [c for c in COMMANDS if options.only is None or c.name in options.only]:
        result = survive(command, options.kills, options.seed)
        figures[command.name] = result.__dict__
        files = f"{min(result.progress)} to {max(result.progress)}"
        counts = [options.kills, files, sum(result.remains), result.left, result.identical]
        rows.append([command.name, f"{result.seconds:.1f}", *map(str, counts)])
    print(table(HEAD, rows))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
