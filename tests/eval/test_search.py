"""`python -m eval.search` as a user runs it: small, on the embedded scenes, with the real detector."""

import csv
import json

import pytest
import yaml

from eval.search import search
from eval.search.run import SearchConfig
from semfov.runs.config import PolicyConfig
from semfov.runs.presets import label
from tests.small import run_settings


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A run of two scenes on 4 × 3 cells."""
    policies = ("random", "itti-koch", PolicyConfig("non-predictive", tempering=0.25), "non-predictive-raw")
    settings = run_settings(tmp_path_factory.mktemp("search"), 2, starts=3, shifts=6)
    return SearchConfig(**settings, policies=policies, scanpaths=1)


@pytest.fixture(scope="session")
def finished(small):
    """The small run, finished."""
    search(small)
    return small


def test_run_writes_records_tables_and_figures(finished):
    records = [json.loads(line) for line in (finished.out / "episodes.jsonl").read_text().splitlines()]
    policies = [label(choice, "search") for choice in finished.policies]
    assert policies[2] == "non-predictive-raw, tempering 0.25"
    assert list(dict.fromkeys(record["policy"] for record in records)) == policies
    for record in records:
        assert record["start"] == record["cells"][0]
        assert record["start"] not in record["goal"]
        assert len(set(record["cells"])) == len(record["cells"]) <= finished.protocol.shifts + 1
        hits = [shift for shift, cell in enumerate(record["cells"]) if cell in record["goal"]]
        assert record["found_at"] == (hits[0] if hits else -1)
    with (finished.out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 4 * 7
    everything = [r for r in rows if r["average"] == "all targets" and r["policy"] == "random" and r["shifts"] == "6"]
    by_scene = {}
    for record in records:
        if record["policy"] == "random":
            by_scene.setdefault(record["scene"], []).append(record["found_at"] >= 0)
    expected = sum(sum(found) / len(found) for found in by_scene.values()) / len(by_scene)
    assert float(everything[0]["performance"]) == pytest.approx(expected, abs=1e-6)
    manifest = json.loads((finished.out / "manifest.json").read_text())
    assert manifest["eye"]["detector"]["digest"]
    settings = yaml.safe_load((finished.out / "config.yaml").read_text())
    assert settings["protocol"]["starts"] == 3
    assert settings["policies"][2]["tempering"] == 0.25
    pictures = sorted(path.name for path in finished.out.glob("*.png"))
    assert pictures[0] == "cumulative_performance.png"
    assert len(pictures) == 2
    summary = (finished.out / "summary.md").read_text()
    assert "CP@5" in summary
    assert "| non-predictive-raw, tempering 0.25 |" in summary
