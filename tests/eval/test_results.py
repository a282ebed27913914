"""The results page: tables come from what runs wrote, and differences are paired."""

import json

import numpy as np
import pytest

from eval.experiments import ResultsConfig, experiments
from eval.results import agreement, fill, paired, summary
from eval.setup import split_policy
from semfov.errors import InputError


@pytest.fixture
def runs(tmp_path):
    config = ResultsConfig(root=tmp_path, annotations=tmp_path / "a.json", out=tmp_path)
    made = experiments(config)
    folder = made["search-tiny"].out
    folder.mkdir()
    (folder / "summary.md").write_text("**one** (1)\n\n| a |\n|---|\n| 1 |\n\n**two** (2)\n\n| b |\n")
    rng = np.random.default_rng(0)
    records = [
        {"policy": policy, "scene": scene, "found_at": int(rng.integers(-1, 12))}
        for policy in ("random", "clever")
        for scene in range(6)
        for _ in range(4)
    ]
    (folder / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    return made, records


def test_every_policy_of_the_page_is_known(runs):
    for run in runs[0].values():
        kind = "search" if hasattr(run, "scanpaths") else "exploration"
        for policy in run.policies:
            split_policy(policy, kind)


def test_lines_become_tables(runs):
    text = fill("before\n@@ search-tiny second\nafter\n", runs[0])
    assert text == "before\n**two** (2)\n\n| b |\nafter\n"
    assert fill("@@ explore-nano all\n", runs[0]) == "*Not run yet.*\n"
    assert fill("@@ explore-five-levels-nano first\n", runs[0]) == "*Not run yet.*\n"
    assert fill("@@ sensitivity\n", runs[0]).count("not run yet") > 50
    assert fill("@@ sensor\n", runs[0]).count("not run yet") == 9 * 2 * 5
    assert fill("@@ explore-sensor\n", runs[0]).count("not run yet") == 6 * 2 * 7
    assert summary(runs[0]["search-tiny"].out, 0)[0] == "**one** (1)"
    with pytest.raises(InputError, match="did you mean 'search-tiny'"):
        fill("@@ search-tin first\n", runs[0])
    with pytest.raises(InputError, match="table"):
        fill("@@ search-tiny third\n", runs[0])


def test_differences_are_paired_over_images(runs):
    made, records = runs
    rows = paired(made["search-tiny"].out, "random", (1, 5))
    differences = []
    for scene in range(6):
        rate = {
            policy: np.mean([0 <= r["found_at"] <= 5 for r in records if (r["policy"], r["scene"]) == (policy, scene)])
            for policy in ("random", "clever")
        }
        differences.append(rate["clever"] - rate["random"])
    expected = f"{100 * np.mean(differences):+.1f} ± {100 * np.std(differences, ddof=1) / np.sqrt(6):.1f}"
    assert len(rows) == 3
    assert expected in rows[2]


def test_agreement_compares_the_same_episodes(tmp_path):
    records = [
        {
            "policy": f"{policy}-{mode}",
            "cells": [0, 1 + (policy == "predictive" and mode == "raw" and n == 0)],
            "found_at": n,
        }
        for policy in ("non-predictive", "predictive")
        for mode in ("raw", "calibrated")
        for n in range(4)
    ]
    (tmp_path / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    rows = agreement(tmp_path)
    assert [cell.strip() for cell in rows[2].split("|")[1:-1]] == ["raw", "75.0 %", "100.0 %"]
    assert [cell.strip() for cell in rows[3].split("|")[1:-1]] == ["calibrated", "100.0 %", "100.0 %"]


def test_a_study_has_a_row_for_each_setting_and_policy(runs):
    folder = runs[0]["explore-sensor YOLOX-nano, fovea 50 px, growth 1"].out
    folder.mkdir()
    (folder / "summary.md").write_text("**one**\n")
    right = {"random-raw": (1, 2), "closer-look-raw+mild": (3, 4)}
    records = [
        {"policy": policy, "scene": scene, "right": [counts[scene]] * 21, "object_cells": 4}
        for policy, counts in right.items()
        for scene in (0, 1)
    ]
    (folder / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    rows = [
        [cell.strip() for cell in row.split("|")[1:-1]] for row in fill("@@ explore-sensor\n", runs[0]).splitlines()
    ]
    assert rows[0] == ["setting", "policy", "0", "1", "2", "3", "4", "10", "20"]
    assert rows[2][:3] == ["YOLOX-nano, fovea 50 px, growth 1", "random-raw", "37.5 ± 12.5"]
    assert rows[3][1:3] == ["closer-look-raw+mild", "87.5 ± 12.5"]
    assert len(rows) == 2 + 6 * 2
