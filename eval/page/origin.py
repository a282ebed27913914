"""Which experiments have run, and of which commit, day and photographs a table is."""

import json
import re
from collections.abc import Iterable
from pathlib import Path

from eval.comparison.summary import MANIFEST
from eval.page.tables import Runs

END = "<!-- end -->"
PLACE = re.compile(rf"<!-- table (?P<name>.+?)(?: -- (?P<origin>.+?))? -->.*?{END}", re.DOTALL)
"""A table of a page, between the comment that names it and the one that ends it."""


def missing(names: Iterable[str], runs: Runs) -> list[str]:
    """Return the experiments among these that have not run."""
    return [name for name in names if name not in runs or not (runs[name].out / MANIFEST).exists()]


def origin(folders: Iterable[Path]) -> str:
    """Return commits, days and numbers of photographs of runs, each only once, as the pages say them."""
    manifests = [json.loads((folder / MANIFEST).read_text(encoding="utf-8")) for folder in folders]
    # A commit by its seven digits, with `+` after uncommitted changes.
    found = [each["commit"] for each in manifests]
    commits = ["no commit" if commit is None else commit[:7] + commit[40:] for commit in found]
    days = [each["date"] for each in manifests]
    counts = [f"{each['scenes']} photographs" for each in manifests]
    return ", ".join(" and ".join(dict.fromkeys(values)) for values in (commits, days, counts))
