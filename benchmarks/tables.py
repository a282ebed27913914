"""Results as Markdown tables, and the two files that every run writes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.timing import Measured, Spread

RESULTS = Path(__file__).parent / "results"


def number(value: float) -> str:
    """A number with three significant digits, or a whole number from 100 on."""
    return f"{value:.3g}" if value < 100 else f"{value:,.0f}"


def spread(values: Spread) -> str:
    """Median and quartiles, as text."""
    return f"{number(values.middle)} ({number(values.low)} to {number(values.high)})"


def comparison_rows(measured: Measured) -> list[list[str]]:
    """Table rows of a comparison, one for each peer."""
    times = measured.milliseconds
    return [
        [measured.name, peer, number(times["semfov"].middle), number(times[peer].middle), spread(ratio)]
        for peer, ratio in measured.ratios.items()
    ]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def write(folder: Path, name: str, text: str, figures: Mapping[str, object]) -> None:
    """Write `name.md` and `name.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.md").write_text(text, encoding="utf-8")
    (folder / f"{name}.json").write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    print(f"written: {folder / name}.md and .json")
