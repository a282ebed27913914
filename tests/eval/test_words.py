"""`python -m eval.words` on embedded scenes with the real detector: arms, pairs and controls, against loops."""

import json
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import torch

from eval.words.run import WordsConfig, differences, outcome_tables, words
from semfov.belief import ContextPrior
from semfov.detection.class_names import COCO_CLASSES
from semfov.errors import InputError
from semfov.runs.config import BeliefConfig, DataConfig, PolicyConfig, ProtocolConfig

pytestmark = pytest.mark.weights


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("words")


@pytest.fixture(scope="module")
def config(folder):
    generator = torch.Generator().manual_seed(0)
    table = folder / "table.csv"
    rows = torch.randn(80, 80, generator=generator).tolist()
    lines = [",".join([name, *map(str, row)]) for name, row in zip(COCO_CLASSES, rows, strict=True)]
    table.write_text("\n".join([",".join(["", *COCO_CLASSES]), *lines]))
    prior = ContextPrior.from_table(table, COCO_CLASSES, source="noise")
    prior.save(folder / "noise.safetensors")
    return WordsConfig(
        data=DataConfig(limit=2),
        belief=BeliefConfig(columns=4, rows=3),
        protocol=ProtocolConfig(starts=3, shifts=6),
        policy=PolicyConfig("non-predictive", tempering=0.25),
        weights=(1.0, 2.0),
        tables=(folder / "noise.safetensors",),
        out=folder / "out",
        cache=folder / "cache",
        workers=1,
    )


@pytest.fixture(scope="module")
def records(config):
    words(config)
    return [json.loads(line) for line in (config.out / "episodes.jsonl").read_text().splitlines()]


@pytest.mark.slow
def test_every_arm_has_the_same_starts(records):
    arms = defaultdict(list)
    for record in records:
        search = record["scene"], record["target"], record["repetition"], record["start"], record["first_score"]
        arms[record["arm"]].append(search)
    assert list(arms) == ["none", "counted", "noise", "noise, permuted"]
    assert len({json.dumps(searches) for searches in arms.values()}) == 1
    cells = {arm: [record["cells"] for record in records if record["arm"] == arm] for arm in arms}
    assert cells["noise"] != cells["none"]
    assert cells["noise"] != cells["noise, permuted"]


@pytest.mark.slow
def test_differences_are_paired_search_by_search(records):
    got = differences(records, "noise", 6)
    found = {(r["arm"], r["scene"], r["target"], r["repetition"]): r["found_at"] for r in records}
    scenes = defaultdict(list)
    for (arm, scene, target, repetition), at in found.items():
        if arm == "noise":
            without = found["none", scene, target, repetition]
            scenes[scene].append([float(0 <= at <= n) - float(0 <= without <= n) for n in range(7)])
    means = np.array([np.mean(each, axis=0) for each in scenes.values()])
    np.testing.assert_allclose(got.mean, means.mean(0))
    np.testing.assert_allclose(got.over_images, means.std(0, ddof=1) / np.sqrt(len(means)))


@pytest.mark.slow
def test_table_lists_searches_that_miss_at_the_first_look_separately(records, config):
    arms = ["none", "counted", "noise", "noise, permuted"]
    scores = sorted(record["first_score"] for record in records if record["arm"] == "none")
    middle = scores[len(scores) // 2]
    below = sum(score < middle for score in scores)
    assert 0 < below < len(scores)
    text = "\n".join(outcome_tables(records, arms, replace(config, missed=middle)))
    assert f", {len(scores)} searches per arm" in text
    assert f", {below} searches per arm" in text
    assert "misses the target: none." in "\n".join(outcome_tables(records, arms, replace(config, missed=0.0)))


def test_tables_need_different_names(config, folder):
    twice = (folder / "noise.safetensors", folder / "noise.safetensors")
    with pytest.raises(InputError, match="different names"):
        words(replace(config, tables=twice, out=folder / "y"))
