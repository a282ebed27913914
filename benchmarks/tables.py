"""What benchmarks that write a page share: options, numbers, tables, and the two files of a run."""

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.machine import describe, use_threads
from benchmarks.timing import Clock, Measured, Spread, clock_for

RESULTS = Path(__file__).parent / "results"


def command(name: str, description: str | None, seconds: float, threads: int = 1) -> argparse.ArgumentParser:
    """Make a command line with the options of all benchmarks that write a page."""
    lines = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(f"python -m {name}", description=description, formatter_class=lines)
    parser.add_argument("--seconds", type=float, default=seconds, help="shortest duration of each measurement")
    parser.add_argument("--threads", type=int, default=threads, help="number of threads")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result files")
    return parser


def begin(options: argparse.Namespace) -> tuple[Clock, dict[str, str]]:
    """Set the number of threads; returns the clock for it and the description of the machine."""
    use_threads(options.threads)
    clock, times = clock_for(options.threads)
    return clock, describe() | {"times": times}


def number(value: float) -> str:
    """Write a number with three significant digits, or a whole number from 100 on."""
    return f"{value:.3g}" if value < 100 else f"{value:,.0f}"


def spread(values: Spread) -> str:
    """Median and quartiles, as text."""
    return f"{number(values.middle)} ({number(values.low)} to {number(values.high)})"


def ratios_of(figures: Mapping[str, Any]) -> dict[tuple[str, str], Spread]:
    """Ratios by work and peer from the JSON of a run."""
    every = [(each["name"], each["ratios"]) for each in figures["comparisons"]]
    return {(name, peer): Spread(**ratio) for name, ratios in every for peer, ratio in ratios.items()}


def comparison_rows(measured: Measured, earlier: Mapping[tuple[str, str], Spread] | None = None) -> list[list[str]]:
    """Table rows of a comparison, one for each peer, with the ratios of an earlier run in a last column."""
    times, name = measured.milliseconds, measured.name
    return [
        [
            name,
            peer,
            number(times["semfov"].middle),
            number(times[peer].middle),
            spread(ratio),
            *([] if not earlier else [spread(earlier[name, peer]) if (name, peer) in earlier else ""]),
        ]
        for peer, ratio in measured.ratios.items()
    ]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Write a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def page(title: str, text: str, about: Mapping[str, str], *sections: str) -> str:
    """Write a Markdown page: title, text, the machine, and sections."""
    machine = "\n".join(f"- {key}: {value}" for key, value in about.items())
    return "\n\n".join([f"# {title}", text, machine, *sections]) + "\n"


def write(folder: Path, name: str, text: str, figures: Mapping[str, object]) -> None:
    """Write `name.md` and `name.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text, encoding="utf-8")
    (folder / f"{name}.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(f"written: {folder / name}.md and .json")
