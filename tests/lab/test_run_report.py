"""The page of a run: curves, episodes as recorded, and the limit on its size."""

import json
import re

import numpy as np
import pytest

import eval.comparison.report_page as module
from eval.comparison.report_page import _choose_episodes, write_run_report
from eval.explore import report as explore_report
from eval.explore.run import ExploreConfig, ExploreRun
from eval.search import report as search_report
from eval.search.run import SearchConfig, SearchRun
from tests.small import run_settings

pytestmark = pytest.mark.weights


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    return run_settings(tmp_path_factory.mktemp("report"), 2, starts=2, shifts=5)


@pytest.fixture(scope="module")
def searched(settings):
    run = SearchRun(SearchConfig(**settings, policies=("random", "non-predictive-raw")))
    return run, [record for index in range(2) for record in run.outcomes(index)[0]]


def write_search(run, records, **options):
    policies = list(run.policies)
    curves = {"all targets": search_report.performance(records, policies, 5, "all targets")}
    path = write_run_report(
        run,
        records,
        curves,
        titles=search_report._AVERAGES,
        label="targets found (%)",
        shifts=search_report._SEARCH_SHIFTS,
        others={"random, by formula": search_report._expected_random(records, 5, 12)},
        **options,
    )
    page = path.read_text(encoding="utf-8")
    return curves, page, json.loads(re.search(r'id="data">(.*?)</script>', page, re.S)[1])


@pytest.mark.slow
def test_the_page_of_a_search_run_shows_curves_and_episodes(searched):
    run, records = searched
    curves, page, data = write_search(run, records)
    chosen = _choose_episodes(records, list(run.policies), 18)
    assert len(chosen) == 4
    for episode, record in zip(data["episodes"], chosen, strict=True):
        assert [each["cell"] for each in episode["fixations"]] == record["cells"]
        assert record["policy"] in episode["name"]
        assert episode["target"] == record["target_name"]
        assert episode["found"] == (record["found_at"] >= 0)
    policies = [record["policy"] for record in chosen]
    assert policies == ["random", "non-predictive-raw"] * 2
    curve = curves["all targets"]["random"]
    assert f"{100 * curve.mean[5]:.1f} ± {100 * curve.over_images[5]:.1f}" in page
    assert "random, by formula" in page
    assert "min_instances" in page


def test_the_size_limit_leaves_one_episode(searched, monkeypatch):
    run, records = searched
    monkeypatch.setattr(module, "_MOST_BYTES", 1)
    _, _, data = write_search(run, records)
    assert len(data["episodes"]) == 1


def test_the_page_of_an_exploration_run_shows_episodes_as_recorded(settings):
    run = ExploreRun(ExploreConfig(**settings, policies=("random-raw", "kl-calibrated")))
    records = run.outcomes(0)[0]
    curves = {"all classes": explore_report.success(records, list(run.policies), "all classes")}
    path = write_run_report(
        run,
        records,
        curves,
        titles={"all classes": "all classes"},
        label="cells with the right class (%)",
        shifts=explore_report._EXPLORATION_SHIFTS,
    )
    data = json.loads(re.search(r'id="data">(.*?)</script>', path.read_text(encoding="utf-8"), re.S)[1])
    assert [episode["target"] for episode in data["episodes"]] == [None, None]
    kl = next(record for record in records if record["policy"] == "kl-calibrated" and record["repetition"] == 0)
    assert [each["cell"] for each in data["episodes"][1]["fixations"]] == kl["cells"]
    # The replayed values explain the gaze: the next cell has the greatest value of those not yet visited.
    fixations = data["episodes"][1]["fixations"]
    for number, each in enumerate(fixations[:-1]):
        values = np.array(each["values"], dtype=float)
        values[[earlier["cell"] for earlier in fixations[: number + 1]]] = -np.inf
        assert values[each["next"]] == pytest.approx(values.max(), rel=1e-3)
