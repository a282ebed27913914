"""Runs that are killed at a random moment and started again: is the result the same to the last bit?

Each repetition starts a command on the embedded scenes, kills it (SIGKILL) after a random share of the time that a
whole run takes, starts it again, and compares what it leaves with what a run leaves that nobody disturbs:

- `store`: `eval.search` while it looks from every cell and keeps what it saw;
- `evaluation`: `eval.search` with that store there, while it runs policies and writes its report;
- `fit`: `train.fit_fom` from the first look to the fitted model.

Runs are forked from one process that has imported everything, so that kills hit work and not the start of Python.

python -m benchmarks.faults --repetitions 50
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import random
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot  # noqa: F401 (imported once for all forks)
import torch
from safetensors import safe_open

from eval.cached import checksum
from eval.search import main as search
from train.fit_fom import main as fit

Main = Callable[[Sequence[str]], int]

_SCENES = ["--data.limit", "3", "--workers", "1"]
_SEARCH = [
    *_SCENES, "--belief.columns", "3", "--belief.rows", "2", "--protocol.starts", "3", "--protocol.shifts", "5",
    "--scanpaths", "0", "--policies", '["random", "non-predictive-raw", "predictive-calibrated"]',
]  # fmt: skip
_FIT = [*_SCENES, "--data.limit", "6", "--fixations", "2", "--holdout", "3", "--shard", "1", "--method", "newton"]


@dataclass(frozen=True)
class Command:
    """A command and what it must leave.

    Attributes:
        name: in tables.
        main: the command.
        arguments: without folders.
        results: files of `out` that must be the same to the last bit.
        stored: whether the store is there already.
    """

    name: str
    main: Main
    arguments: tuple[str, ...]
    results: tuple[str, ...]
    stored: bool = False

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


COMMANDS = (
    Command("store", search, (*_SEARCH[:-1], '["random"]'), ("episodes.jsonl", "summary.csv")),
    Command("evaluation", search, tuple(_SEARCH), ("episodes.jsonl", "summary.csv"), stored=True),
    Command("fit", fit, tuple(_FIT), ("yolov3-tiny.safetensors", "report.md", "counts.csv")),
)


@dataclass(frozen=True)
class Survived:
    """What came of the repetitions of a command.

    Attributes:
        seconds: of an undisturbed run.
        killed: repetitions in which the kill came before the end.
        progress: for each of them, files that were there, finished, when it was killed.
        remains: for each of them, unfinished files that were left behind.
        identical: repetitions whose result is that of the undisturbed run.
    """

    seconds: float
    killed: int
    progress: list[int]
    remains: list[int]
    identical: int


def survive(command: Command, repetitions: int, seed: int = 0) -> Survived:
    """Kill and resume a command so often."""
    fork = multiprocessing.get_context("fork")
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        whole, cache = folder / "whole", folder / "looks"
        cache.mkdir()
        if command.stored:
            finish(fork.Process(target=command.run, args=(whole,)))
            (whole / "cache").rename(cache / "cache")
            shutil.rmtree(whole)
        shutil.copytree(cache, whole)
        seconds = finish(fork.Process(target=command.run, args=(whole,)))
        expected = command.digest(whole)
        killed, identical, progress, remains = 0, 0, [], []
        for repetition in range(repetitions):
            here = folder / str(repetition)
            shutil.copytree(cache, here)
            process = fork.Process(target=command.run, args=(here,))
            process.start()
            process.join(chance.random() * seconds)
            if process.is_alive():
                process.kill()
                killed += 1
            process.join()
            files = [file for file in here.rglob("*") if file.is_file()]
            parts = sum(file.suffix == ".part" for file in files)
            progress.append(len(files) - parts)
            remains.append(parts)
            finish(fork.Process(target=command.run, args=(here,)))
            identical += command.digest(here) == expected
            shutil.rmtree(here)
    return Survived(seconds, killed, progress, remains, identical)


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
    parser.add_argument("--repetitions", type=int, default=50, help="of each command")
    parser.add_argument("--only", nargs="+", choices=[c.name for c in COMMANDS], help="these commands; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="write the figures here too")
    options = parser.parse_args()
    print("| run | s | repetitions | killed before the end | finished files then | unfinished | same bits |")
    print("|---|---|---|---|---|---|---|", flush=True)
    figures = {}
    for command in [c for c in COMMANDS if options.only is None or c.name in options.only]:
        came = survive(command, options.repetitions, options.seed)
        figures[command.name] = came.__dict__
        files = f"{min(came.progress)} to {max(came.progress)}"
        cells = [f"{came.seconds:.1f}", options.repetitions, came.killed, files, sum(came.remains), came.identical]
        print(f"| {command.name} | {' | '.join(map(str, cells))} |", flush=True)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
