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
    commits = []
    days = []
    counts = []
    for folder in folders:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        commits.append("no commit" if manifest["commit"] is None else _short(manifest["commit"]))
        days.append(manifest["date"])
        counts.append(f"{manifest['scenes']} photographs")
    return ", ".join([_listed(commits), _listed(days), _listed(counts)])


def _short(commit: str) -> str:
    """Shorten a commit of 40 digits to seven; what follows them, `+` after uncommitted changes, stays."""
    return commit[:7] + commit[40:]


def _listed(values: Iterable[str]) -> str:
    """List different values, each only once."""
    return " and ".join(dict.fromkeys(values))
