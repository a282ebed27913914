"""A run over many scenes with stub looks: `python -m benchmarks.scale`, with `--scenes 118000` as many as COCO has.

A process runs the scenes and is killed when half of them are finished. A second one continues, and reads all records.
The table tells how long it took to find out what was finished, and how much memory the process took, beside a run over
a tenth of the scenes. With `--cluster` it tells instead what the scenes cost the process that gives them to a worker.
"""

import argparse
import hashlib
import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.tables import begin, command, number, page, table, write
from eval.comparison.records import gather
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun, finish

TEXT = """\
Written by `python -m benchmarks.scale`. Each scene has 5 episodes of each of 12 policies, whose records are made
without looks. The first process was killed when half of the scenes were finished, and the second one continued."""

POLICIES, EPISODES, SHIFTS = 12, 5, 30


@dataclass(frozen=True)
class StubConfig:
    """Settings of a run over so many scenes."""

    out: Path
    scenes: int
    where: int | str = 1

    def plain(self) -> dict[str, Any]:
        """Return the settings that outcomes depend on."""
        return {"scenes": self.scenes}


class StubScenes:
    """Scenes without pixels."""

    fingerprint = "stub"

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def digest(self, index: int) -> str:
        """Return a digest as of a photograph."""
        return hashlib.sha256(str(index).encode()).hexdigest()


class StubRun(SceneRun):
    """Records as long as those of searches, without looks."""

    def __init__(self, config: StubConfig) -> None:
        self.config, self.scenes = config, StubScenes(config.scenes)  # type: ignore[assignment]

    def depends_on(self) -> dict[str, Any]:
        """Nothing but the settings."""
        return self.config.plain()

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Return the same episodes for each scene."""
        records = [
            {"scene": index, "policy": policy, "repetition": repetition, "cells": [*range(SHIFTS)], "found_at": SHIFTS}
            for policy in range(POLICIES)
            for repetition in range(EPISODES)
        ]
        return records, {"look": 0.0}


def work(folder: Path, scenes: int) -> None:
    """Run the scenes, read the records, and print what it took."""
    run = StubRun(StubConfig(folder, scenes))
    began = time.perf_counter()
    before = len(run.results.finished(scenes))
    restart = time.perf_counter() - began
    finish(run, "stub looks")
    records = sum(1 for _ in gather(run))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"before": before, "restart": restart, "records": records, "peak": peak}))


def start(folder: Path, scenes: int) -> subprocess.Popen[str]:
    """Start a process that runs the scenes."""
    call = [sys.executable, "-m", "benchmarks.scale", "--scenes", str(scenes), "--work", str(folder)]
    return subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def finished(process: subprocess.Popen[str]) -> dict[str, float]:
    """Wait for a process, and read the numbers that it prints at its end."""
    numbers: dict[str, float] = json.loads(process.communicate()[0].splitlines()[-1])
    return numbers


def killed_and_continued(scenes: int) -> list[dict[str, float]]:
    """Return what a run over a tenth of the scenes tells, and one that was killed and continued."""
    with tempfile.TemporaryDirectory() as small, tempfile.TemporaryDirectory() as large:
        few = finished(start(Path(small), max(1, scenes // 10)))
        process, results = start(Path(large), scenes), StubRun(StubConfig(Path(large), scenes)).results
        while process.poll() is None and len(results) < scenes // 2:
            time.sleep(0.1)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        many = finished(start(Path(large), scenes))
        size = sum(path.stat().st_size for path in Path(large).rglob("*") if path.is_file()) / 2**20
    return [{"scenes": max(1, scenes // 10), **few, "size": 0.0}, {"scenes": scenes, **many, "size": size}]


def coordination(scenes: int) -> float:
    """Milliseconds of the processor that scheduler and coordinator need for each scene, with one worker."""
    from distributed import LocalCluster

    def seconds(count: int) -> float:
        began = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            finish(StubRun(StubConfig(Path(folder), count, cluster.scheduler_address)), "stub looks")
        return time.process_time() - began

    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        few = max(1, scenes // 10)
        seconds(few)  # imports
        return 1e3 * (seconds(scenes) - seconds(few)) / (scenes - few)


def main() -> None:
    """Measure, and write the table."""
    parser = command("benchmarks.scale", __doc__, seconds=0.0)
    parser.add_argument("--scenes", type=int, default=2000, help="number of scenes")
    parser.add_argument("--cluster", action="store_true", help="measure what a cluster costs its coordinator")
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work is not None:
        work(options.work, options.scenes)
        return
    if options.cluster:
        print(f"{coordination(options.scenes):.2f} ms of the coordinator's processor for each scene")
        return
    _, about = begin(options)
    runs = killed_and_continued(options.scenes)
    head = ["scenes", "finished before", "restart, s", "records", "peak memory, MiB", "database, MiB"]
    names = ("scenes", "before", "restart", "records", "peak", "size")
    rows = [[number(run[name]) if run[name] else "0" for name in names] for run in runs]
    assert all(run["records"] == run["scenes"] * POLICIES * EPISODES for run in runs)
    write(options.out, "scale", page("Scale", TEXT, about, table(head, rows)), {"machine": about, "runs": runs})


if __name__ == "__main__":
    main()
