"""The pages of results: tables from the files of runs, and paired differences."""

import json
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from eval.explore.run import ExploreConfig
from eval.page import paper
from eval.page.curves import behind, corrected_signs, paired_difference
from eval.page.experiments import AT_THRESHOLDS, SCORE_THRESHOLDS, ResultsConfig, experiments
from eval.page.figures import PAGE_FIGURES, draw_figures
from eval.page.findings import _BASELINES, _FINDINGS, COUNTED, TESTED, VERDICTS, Finding, _Advantage, _Overtaken
from eval.page.origin import PLACE, missing, origin
from eval.page.tables import by_samples
from eval.page.thresholds import CONTRASTS
from eval.results import _WHOLE, _fill_page, _page_table, results
from eval.search.run import SearchConfig
from semfov.runs.presets import label
from tests.refusals import refused, unusable

ROOT = Path(__file__).parents[2]


def write_manifest(folder, commit="1a2b3c4d" * 5, date="2026-11-23", scenes=6):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "manifest.json").write_text(json.dumps({"commit": commit, "date": date, "scenes": scenes}))


def write_records(folder, records):
    write_manifest(folder)
    shown = (
        "| policy | CP@1 | CP@5 | CP@10 | CP@15 | CP@30 |\n|---|---|---|---|---|---|\n| random | 1 | 2 | 3 | 4 | 5 |\n"
    )
    (folder / "summary.md").write_text(f"**one** (1)\n\n{shown}\n**two** (2)\n\n| b |\n|---|\n")
    (folder / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))


def searches(policies, found_at):
    """Searches of six scenes, four starts each; `found_at` is a function of policy, scene and repetition."""
    return [
        {
            "policy": policy,
            "scene": scene,
            "repetition": repetition,
            "commonest": scene % 2 == 0,
            "goal": [1, 2],
            "cells": [0, scene, 5],
            "found_at": found_at(policy, scene, repetition),
        }
        for policy in policies
        for scene in range(6)
        for repetition in range(4)
    ]


def lines_of(name, runs):
    return _page_table(name, runs).make(runs)


def cells_of(row):
    return [cell.strip() for cell in row.split("|")[1:-1]]


@pytest.fixture
def runs(tmp_path):
    config = ResultsConfig(
        root=tmp_path,
        annotations=tmp_path / "a.json",
        fit_root=tmp_path,
        fit_annotations=tmp_path,
        out=tmp_path / "out",
    )
    return experiments(config)


@pytest.fixture
def searched(runs):
    rng = np.random.default_rng(0)
    records = searches(("random", "clever"), lambda *_: int(rng.integers(-1, 12)))
    write_records(runs["beyond-search-nano"].out, records)
    return runs, records


def test_the_policies_of_each_run_have_different_labels(runs):
    for run in runs.values():
        if not isinstance(run, SearchConfig | ExploreConfig):
            continue
        task = "search" if isinstance(run, SearchConfig) else "exploration"
        labels = [label(choice, task) for choice in run.policies]
        assert len(set(labels)) == len(labels) > 0


def test_studies_use_the_fit_set_and_results_the_listed_photographs_up_to_a_limit(tmp_path):
    config = ResultsConfig(root=tmp_path / "val", annotations=tmp_path / "v.json", fit_root=tmp_path / "fit")
    for name, run in experiments(config).items():
        study = " " in name
        assert run.data.root == (config.fit_root if study else config.root)
        assert run.data.ids == (None if study else config.ids)
    ids = (ROOT / config.ids).read_text().split()
    assert len(set(ids)) == len(ids) == 300
    config = ResultsConfig(root=tmp_path / "val", annotations=tmp_path / "v.json")
    limits = {run.data.limit for run in experiments(replace(config, limit=7)).values()}
    assert limits == {7}
    assert {run.data.limit for run in experiments(replace(config, limit=200)).values()} == {200, 100}
    assert {run.data.limit for run in experiments(config).values()} == {None, 100}


def place(name, content="anything"):
    return f"<!-- table {name} -->\n\n{content}\n\n<!-- end -->"


def test_tables_of_runs_are_renewed_and_the_rest_of_the_page_stays(searched):
    runs, _ = searched
    page = "before\n{}\nbetween\n{}\nafter\n"
    others = [place("explore-published-nano explore -- 7654321, 2026-11-01, 300 photographs"), place("sensitivity")]
    other = "\n".join([*others, place("findings")])
    text, kept = _fill_page(page.format(place("beyond-search-nano search"), other), runs)
    shown = ["| policy | CP@1 | CP@5 | CP@15 | CP@30 |", "|--------|------|------|-------|-------|"]
    table = "\n".join([*shown, "| random | 1    | 2    | 4     | 5     |"])
    renewed = place("beyond-search-nano search -- 1a2b3c4, 2026-11-23, 6 photographs", table)
    assert text == page.format(renewed, other)
    assert kept == ["explore-published-nano explore", "sensitivity", "findings"]
    assert _fill_page(text, runs) == (text, kept)


def test_a_table_of_several_experiments_waits_for_all_of_them(runs):
    for made in _WHOLE.values():
        assert missing(made.made_of, runs) == list(made.made_of) != []
    study = _page_table("sensitivity", runs).made_of
    for name in study[1:]:
        write_manifest(runs[name].out)
    assert missing(study, runs) == ["sensitivity as published"]
    measured = {name: run for name, run in runs.items() if " " not in name}
    assert missing(study, measured) == list(study), "without a fit set no study runs"


def test_the_origin_of_a_table_names_every_commit_day_and_number_of_photographs(tmp_path):
    folders = [tmp_path / name for name in "abc"]
    write_manifest(folders[0])
    write_manifest(folders[1], "7" * 40 + "+", "2026-11-24")
    write_manifest(folders[2], None)
    assert origin(folders[:1]) == "1a2b3c4, 2026-11-23, 6 photographs"
    assert origin(folders) == "1a2b3c4 and 7777777+ and no commit, 2026-11-23 and 2026-11-24, 6 photographs"


def test_unknown_tables_are_refused(runs):
    refused("did you mean 'beyond-search-nano'", _fill_page, place("beyond-search-nan search"), runs)
    refused("table", _fill_page, place("beyond-search-nano third"), runs)


def test_tables_of_decisions_are_taken_from_their_file(runs):
    """Tables are chosen by their number in the file, without the prose around them."""
    heads = "| looks | hit rate | false-alarm rate | undecided | place right | expected | IoU |"
    out = runs["decide-nano"].out
    write_manifest(out)
    parts = [f"Some words.\n\n{heads}\n|---|\n| {number} |{' x |' * 6}\n" for number in range(4)]
    (out / "decisions.md").write_text("\n".join(parts))
    for number, kind in enumerate(("presence", "decisions")):
        assert lines_of(f"decide-nano {kind}", runs) == [heads, "|---|", f"| {number} | x | x | x | x | x | x |"]


@pytest.mark.parametrize("page", ["results", "tables"])
def test_every_table_of_the_pages_can_be_filled(page, runs):
    text = (ROOT / f"docs/{page}.md").read_text(encoding="utf-8")
    assert text.count("<!--") == 2 * len(PLACE.findall(text))
    for found in PLACE.finditer(text):
        assert set(_page_table(found["name"], runs).made_of) <= runs.keys()
        assert re.fullmatch(r"[0-9a-f]{7}.*, 2\d{3}-\d\d-\d\d.*, \d+ photographs( and \d+.*)?", found["origin"]), found[
            "name"
        ]
        comment, empty, *rows = found[0].splitlines()
        assert (comment, empty) == (f"<!-- table {found['name']} -- {found['origin']} -->", "")
        assert len(rows) > 4
        assert all(row.startswith("|") for row in rows[:-2]), found["name"]


def test_no_table_is_on_both_pages():
    names = [
        name for page in ("results", "tables") for name, _ in PLACE.findall((ROOT / f"docs/{page}.md").read_text())
    ]
    assert len(set(names)) == len(names) > 10


def test_one_command_writes_both_pages_and_says_which_tables_it_renewed(searched, tmp_path, capsys):
    runs, _ = searched
    pages = [tmp_path / f"{name}.md" for name in ("results", "tables")]
    for page in pages:
        page.write_text(f"{page}\n{place('paper')}\n{place('beyond-search-nano search')}\n")
    config = ResultsConfig(
        root=tmp_path,
        annotations=tmp_path / "a.json",
        only=(),
        page=pages[0],
        tables=pages[1],
        pictures=tmp_path,
        out=tmp_path / "out",
    )
    results(config)
    rows = "\n".join(lines_of("beyond-search-nano search", runs))
    table = place("beyond-search-nano search -- 1a2b3c4, 2026-11-23, 6 photographs", rows)
    for page in pages:
        assert page.read_text() == f"{page}\n{place('paper')}\n{table}\n"
    told = capsys.readouterr().out
    assert "renewed: beyond-search-nano search, beyond-search-nano search\n" in told
    assert "have not run: paper, paper, prediction_and_calibration.png, search_baselines.png" in told
    pages[1].unlink()
    unusable(r"tables\.md cannot be read", results, config)


def test_differences_are_paired_over_images(searched):
    runs, records = searched
    mean, error = paired_difference(runs["beyond-search-nano"].out, "clever", "random", 5)
    differences = []
    for scene in range(6):
        rate = {
            policy: np.mean([0 <= r["found_at"] <= 5 for r in records if (r["policy"], r["scene"]) == (policy, scene)])
            for policy in ("random", "clever")
        }
        differences.append(rate["clever"] - rate["random"])
    assert mean[5] == pytest.approx(np.mean(differences))
    assert error[5] == pytest.approx(np.std(differences, ddof=1) / np.sqrt(6))


def rejected_by_closed_testing(chance, alpha):
    """A hypothesis is rejected if every set of hypotheses that it is in has a p-value below its Bonferroni level."""
    numbers = range(len(chance))
    sets = [each for size in range(1, len(chance) + 1) for each in combinations(numbers, size)]
    return [
        all(min(chance[m] for m in each) <= alpha / len(each) for each in sets if number in each) for number in numbers
    ]


@pytest.mark.parametrize("seed", range(8))
def test_signs_are_corrected_as_closed_testing_corrects_them(seed):
    rng = np.random.default_rng(seed)
    mean, error = rng.normal(0, 2.5, 7), rng.uniform(0.5, 1.5, 7)
    chance = 2 * norm.sf(np.abs(mean) / error)
    expected = np.where(rejected_by_closed_testing(chance, 0.05), np.sign(mean), 0)
    np.testing.assert_array_equal(corrected_signs(mean, error), expected)


def test_differences_without_any_error_have_signs():
    np.testing.assert_array_equal(corrected_signs(np.array([0.0, 0.1, -0.1]), np.zeros(3)), [0, 1, -1])
    assert behind(np.array([0.0, -0.1, -0.3, -0.2, 0.4]), np.array([0.0, 0.06, 0.1, 0.1, 0.1])) == [2]


def test_samples_are_compared_with_the_same_policy_without(runs):
    folder = runs["expected-search"].out
    drawn, found = "predictive-raw, samples 16", {"predictive-raw": 3, "predictive-raw, samples 16": 9, "random": 30}
    write_records(folder, searches(tuple(found), lambda policy, scene, _: found[policy] - scene))
    rows = [cells_of(row) for row in by_samples(folder, (1, 5, 9))]
    assert rows[0] == ["difference to the expected scores", "1", "5", "9"]
    # After one shift the plain search has found the targets of scenes 2 and 3, after five of 0 to 3, the other of 4, 5.
    scenes = {n: [(0 <= 9 - s <= n) - float(0 <= 3 - s <= n) for s in range(6)] for n in (1, 5, 9)}
    expected = [f"{100 * np.mean(d):+.1f} ± {100 * np.std(d, ddof=1) / 6**0.5:.1f}" for d in scenes.values()]
    assert rows[2:] == [[drawn, *expected]]


def test_tables_of_the_paper_use_the_commonest_target(runs):
    found = {("random", 0): 3, ("random", 2): 20, ("random", 4): -1}
    records = searches(tuple(paper.TABLE_II | paper.TABLE_I), lambda policy, scene, _: found.get((policy, scene), 1))
    for name in _page_table("paper", runs).made_of:
        write_records(runs[name].out, records)
    rows = [cells_of(row) for row in lines_of("paper", runs)]
    assert rows[0][:4] == ["policy", "", "paper", "YOLOX-nano, wide"]
    # The target of one of the three even scenes is found within 5 and 15 gaze shifts, of two within 30.
    assert rows[2][:4] == ["random", "CP@5", "45.20", "33.3 ± 33.3"]
    assert rows[4][1:4] == ["CP@30", "97.13", "66.7 ± 33.3"]


def test_findings_have_sizes_and_verdicts(tmp_path):
    """VOCUS2 finds every target one shift after random gaze."""
    found = {"random": 9, "vocus2": 10}
    write_records(tmp_path, searches(found, lambda policy, scene, _: found[policy] + 5 * (scene % 2)))
    every, few = COUNTED["search"][1], COUNTED["search"][0]
    finding = Finding("", "search", "", _Advantage("random", "vocus2", (5, 9, 15)))
    assert str(finding.answer(tmp_path, few)) == "+0.0 ± 0.0 / +100.0 ± 0.0 / +0.0 ± 0.0: holds in part"
    assert str(finding.answer(tmp_path, every)) == "+0.0 ± 0.0 / +50.0 ± 22.4 / +0.0 ± 0.0: open"
    assert (
        Finding("", "search", "", _Advantage("random", "vocus2", (5, 30), 0)).answer(tmp_path, every).verdict == "holds"
    )
    first = Finding("", "search", "", _Overtaken("random", "vocus2", "")).answer(tmp_path, few)
    assert str(first) == "ahead at 9, behind at no shift: not overtaken"
    assert not finding.detects
    assert finding.test.published() == "-"
    assert _Advantage("random", "vocus2", (5, 15, 30)).published() == "+29.7 / +43.0 / +28.0"
    assert len({finding.text for finding in _FINDINGS}) == len(_FINDINGS) == len(TESTED) + len(_BASELINES)


def explorations(policies, right):
    """Explorations of six scenes with eight cells; `right` is a function of policy, scene and measure."""
    fields = ("right", "right_without_background", "right_everywhere")
    return [
        {
            "policy": policy,
            "scene": scene,
            "repetition": 0,
            "object_cells": 8,
            "grid_cells": 8,
            **{field: [right(policy, scene, field)] * 21 for field in fields},
        }
        for policy in policies
        for scene in range(6)
    ]


@pytest.fixture
def at_thresholds(runs):
    """At 0.02 calibrated search finds all at once and KL has one cell more; at other thresholds it is the reverse."""
    for name in AT_THRESHOLDS:
        run, low = runs[name], "-0.02-" in name
        if name.startswith("search"):
            records = searches(run.policies, lambda policy, scene, _, low=low: 1 if ("raw" in policy) != low else -1)
        else:
            records = explorations(run.policies, lambda policy, scene, _, low=low: 3 + (policy.startswith("kl") == low))
        write_records(run.out, records)
    return runs


def test_every_threshold_has_a_model_of_its_own_and_the_same_sensor(runs):
    for name in AT_THRESHOLDS:
        run = runs[name]
        assert (run.sensor.name, run.belief.model) == ("published", None)
        assert run.detector.threshold == float(name.split("-")[2])
        assert run.data.limit == 100
    for name in ("nano", "tiny"):
        looks = runs[f"looks-threshold-{name}"]
        assert looks.thresholds == SCORE_THRESHOLDS
        assert list(runs).index(f"looks-threshold-{name}") < list(runs).index(f"search-threshold-0.02-{name}")


def test_differences_and_verdicts_name_their_thresholds(at_thresholds, tmp_path):
    rows = [cells_of(row) for row in _page_table("verdicts", at_thresholds).make(at_thresholds)]
    assert rows[0] == ["the paper finds", "in the paper", "counted", "YOLOX-nano", "YOLOv3-tiny"]
    assert rows[2][1:4] == ["+11.2 / +10.4 / +5.8", "one target", "holds at 0.02; reversed at 0.1, 0.25, 0.5"]
    told = {cell for row in rows[2:] for cell in row[3:]}
    words = [row[0] for row in map(cells_of, _page_table("verdicts-words", at_thresholds).make(at_thresholds)[2:])]
    assert words == [word for word in VERDICTS if any(f"{word} at" in cell for cell in told)]
    rows = [cells_of(row) for row in _page_table("thresholds", at_thresholds).make(at_thresholds)]
    assert rows[0] == ["detector", "difference", "shifts", "0.02", "0.1", "0.25", "0.5"]
    assert rows[2][:5] == ["YOLOX-nano", CONTRASTS[1].text, "30", "+100.0 ± 0.0", "-100.0 ± 0.0"]
    kl = next(row for row in rows if row[1] == "exploration, without background: KL − random, calibrated")
    assert kl[2:5] == ["1", "+12.5 ± 0.0", "-12.5 ± 0.0"]
    assert sum(row[0] == "YOLOv3-tiny" for row in rows) == sum(len(contrast.shifts) for contrast in CONTRASTS[1::2])
    assert [path.stem for path in draw_figures(tmp_path, at_thresholds)] == ["thresholds"]


def test_the_study_of_settings_has_a_row_for_each_of_them(runs):
    found = {"sensitivity prior 2": 4, "sensitivity closest look": 12}
    for name in _page_table("sensitivity", runs).made_of:
        first = found.get(name, 1)
        write_records(runs[name].out, searches(("non-predictive-raw",), lambda *_, first=first: first))
    rows = [cells_of(row) for row in lines_of("sensitivity", runs)]
    assert rows[0] == ["setting", "CP@1", "CP@5", "CP@30"]
    assert rows[2] == ["as published", *["100.0 ± 0.0"] * 3]
    assert ["prior 2", "0.0 ± 0.0", *["100.0 ± 0.0"] * 2] in rows
    assert rows[-1] == ["closest look", "0.0 ± 0.0", "0.0 ± 0.0", "100.0 ± 0.0"]
    assert len(rows) == 2 + 17


@pytest.mark.slow
def test_figures_are_drawn_once_their_experiments_have_run(runs, tmp_path):
    assert draw_figures(tmp_path, runs) == []
    for name in ("nano", "tiny"):
        for fovea in ("published", "published-narrow"):
            run = runs[f"search-{fovea}-{name}"]
            write_records(run.out, searches(run.policies, lambda policy, scene, repetition: scene + repetition))
    drawn = draw_figures(tmp_path, runs)
    assert {path.stem for path in drawn} == {name for name, figure in PAGE_FIGURES.items() if figure.kind == "search"}
    assert all(path.stat().st_size > 10_000 for path in drawn)
