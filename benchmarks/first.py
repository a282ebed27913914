"""The first answer of a new process beside a bare script: `python -m benchmarks.first --picture FILE`.

The bare script imports torch, as every program with a network of PyTorch does, and looks once at the photograph by
onnxruntime and OpenCV (`benchmarks/bare.py`). Each program is a process of its own, with all that it imports. Times are
those of the processor, of all threads.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from shutil import copytree, ignore_patterns

from benchmarks.machine import describe
from benchmarks.tables import RESULTS, number, page, spread, table, write
from benchmarks.timing import Spread
from semfov.detection.weights import fetch
from semfov.errors import check

ROOT = Path(__file__).parents[1]
REPETITIONS = 5
LIMIT = 1.3
TEXT = f"""\
Written by `python -m benchmarks.first`. Seconds of the processor of a new process until it has answered with YOLOX-nano
whether a photograph holds a person, or where all people are, beside a script that imports torch and looks once at the
photograph by onnxruntime and OpenCV. Medians of {REPETITIONS} repetitions in turn; the ratio with quartiles."""

BARE = """
import sys
import torch
import cv2
from benchmarks.bare import BareYolox
boxes, scores, classes = BareYolox(sys.argv[1], 1)(cv2.imread(sys.argv[2])[:, :, ::-1])
print(boxes[classes == 0], scores[classes == 0])
"""
PYTHON = """
import sys
import semfov
agent = semfov.ActivePerception.recommended("yolox-nano", weights=sys.argv[1])
print(agent.search(sys.argv[2], "person").decision)
"""


def programs(picture: Path, model: Path) -> dict[str, list[str]]:
    """Return the command lines by name, the bare script first."""
    words = [str(picture), "person", "--weights", str(model)]
    run = [sys.executable, "-m", "semfov"]
    return {
        "bare script": [sys.executable, "-c", BARE, str(model), str(picture)],
        "semfov search": [*run, "search", *words],
        "semfov find": [*run, "find", *words],
        "agent.search in Python": [sys.executable, "-c", PYTHON, str(model), str(picture)],
    }


def environments(folder: Path) -> dict[str, dict[str, str]]:
    """Return the variables of the environments by name: with all bytecode, without any, and without semfov's."""
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    for part in ("semfov", "benchmarks"):
        copytree(ROOT / part, folder / "copy" / part, ignore=ignore_patterns("__pycache__"))
    nothing = {"PYTHONDONTWRITEBYTECODE": "1"}
    return {
        "bytecode written": plain | {"PYTHONPATH": str(ROOT)},
        "no bytecode": plain | nothing | {"PYTHONPATH": str(ROOT), "PYTHONPYCACHEPREFIX": str(folder / "empty")},
        "no bytecode of semfov": plain | nothing | {"PYTHONPATH": str(folder / "copy")},
    }


def seconds(name: str, words: Sequence[str], environment: Mapping[str, str], folder: Path) -> float:
    """Run a program to its end; returns its seconds of the processor."""
    with subprocess.Popen(words, env=environment, cwd=folder, stdout=subprocess.DEVNULL) as process:
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    check(process.returncode == 0, f"program {name!r}", "the exit code 0", process.returncode)
    return usage.ru_utime + usage.ru_stime


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the table."""
    lines = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m benchmarks.first", description=__doc__, formatter_class=lines)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result files")
    parser.add_argument("--picture", type=Path, required=True, help="photograph (JPEG)")
    parser.add_argument("--weights", type=Path, help="ONNX file of YOLOX-nano")
    options = parser.parse_args(arguments)
    runs = programs(options.picture.resolve(), Path(options.weights or fetch("yolox-nano")).resolve())
    rows, figures = [], {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for label, environment in environments(folder).items():
            run = partial(seconds, environment=environment, folder=folder)
            for program, words in runs.items():
                run(program, words)  # the first time reads files, and writes bytecode
            durations: dict[str, list[float]] = {program: [] for program in runs}
            for _ in range(REPETITIONS):
                for program, words in runs.items():
                    durations[program].append(run(program, words))
            bare, *others = durations
            for program in others:
                pairs = zip(durations[program], durations[bare], strict=True)
                ratio = Spread.of([ours / theirs for ours, theirs in pairs])
                ours, theirs = Spread.of(durations[program]), Spread.of(durations[bare])
                rows.append([label, program, number(ours.middle), number(theirs.middle), spread(ratio), str(LIMIT)])
                figures[f"{label}, {program}"] = {
                    "program": asdict(ours), "bare": asdict(theirs), "ratio": asdict(ratio)
                }  # fmt: skip
                print(" | ".join(rows[-1]), flush=True)
    head = ["environment", "program", "s", "bare script, s", "program by script", "at most"]
    about = describe() | {"times": "of the processor"}
    del about["threads"]  # each program has as many as it takes
    write(options.out, "first", page("First answer", TEXT, about, table(head, rows)), {"machine": about, "s": figures})


if __name__ == "__main__":
    main()
