"""Results of other code, other pixels and other threads are never taken for one's own."""

import json
import logging
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from eval.search import main
from semfov.errors import InputError
from semfov.experiments import run as run_module
from semfov.experiments.config import BeliefConfig, DataConfig, PolicyConfig, ProtocolConfig, SearchConfig
from semfov.experiments.parts import Parts
from semfov.experiments.run import finish
from semfov.experiments.runs import SearchRun
from semfov.experiments.summary import gather
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.policies import POLICIES, Policy

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.weights


@pytest.fixture
def config(tmp_path):
    return SearchConfig(
        data=DataConfig(limit=1),
        belief=BeliefConfig(columns=3, rows=2),
        protocol=ProtocolConfig(starts=2, shifts=3),
        policies=("random",),
        cache=tmp_path / "cache",
        out=tmp_path / "out",
        workers=1,
    )


@pytest.fixture(autouse=True)
def threads():
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.slow
def test_a_finished_run_of_other_code_is_told_and_computed_anew(config, monkeypatch, caplog):
    first = SearchRun(config)
    finish(first, "searching")
    assert first.parts.load(0) is not None
    finish(SearchRun(config), "searching")
    assert not caplog.records
    monkeypatch.setattr(run_module, "package_digest", lambda: "0" * 64)
    second = SearchRun(config)
    assert second.settings_key == first.settings_key
    assert second.key != first.key
    assert second.store.key == first.store.key, "what was seen does not depend on how it is searched"
    assert second.parts.load(0) is None
    with caplog.at_level(logging.WARNING):
        finish(second, "searching")
    (record,) = caplog.records
    assert "1 scenes were finished with these settings by another version of the code" in record.getMessage()
    assert second.parts.load(0) is not None


def test_the_code_of_a_policy_of_the_users_own_counts(config, tmp_path, monkeypatch):
    class Own(Policy):
        name = "own-of-a-test"
        tasks = ("search",)

        def forward(self, target, grid):
            return TargetPosterior(target)

    try:
        chosen = replace(config, policies=(PolicyConfig("own-of-a-test"),))
        key = SearchRun(chosen).key
        assert SearchRun(chosen).key == key
        monkeypatch.setattr(run_module, "class_digest", lambda kind: "changed")
        assert SearchRun(chosen).key != key
        assert SearchRun(config).settings_key != SearchRun(chosen).settings_key
    finally:
        del POLICIES["own-of-a-test"]


def test_an_image_of_the_same_size_is_another_image(tmp_path):
    digest = {"now": "a" * 64}
    parts = Parts(tmp_path, "1-2", lambda index: digest["now"])
    parts.save(3, [{"policy": "random"}], {"look": 0.5})
    assert parts.load(3)["records"] == [{"policy": "random"}]
    digest["now"] = "b" * 64
    assert parts.load(3) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda part: {**part, "seconds": None},
        lambda part: {**part, "seconds": {"look": None}},
        lambda part: {**part, "records": None},
        lambda part: {**part, "records": [None]},
        lambda part: {**part, "records": 3},
        lambda part: {key: value for key, value in part.items() if key != "seconds"},
        lambda part: [part],
        lambda part: None,
    ],
)
def test_a_part_with_something_else_in_it_counts_as_missing(tmp_path, damage):
    parts = Parts(tmp_path, "1-2", lambda index: "a")
    parts.save(0, [{"policy": "random"}], {"look": 0.5})
    part = damage(json.loads(parts.path(0).read_text()))
    if isinstance(part, dict) and {"records", "seconds"} <= part.keys():
        part["sha256"] = parts._sha256(0, part["records"], part["seconds"])
    parts.path(0).write_text(json.dumps(part))
    assert parts.load(0) is None


def test_parts_of_every_other_kind_count_as_missing(tmp_path):
    parts = Parts(tmp_path, "1-2", lambda index: "a")
    parts.folder.mkdir()
    for content in (b"[" * 100_000, b"\xff\xfe", b"", b'{"key": 1' * 9):
        parts.path(0).write_bytes(content)
        assert parts.load(0) is None
    os.mkfifo(parts.path(1))
    assert parts.load(1) is None
    parts.path(2).mkdir()
    assert parts.load(2) is None


@pytest.mark.slow
@pytest.mark.parametrize("detector", ["yolov3-tiny"])
def test_an_emptied_store_is_filled_with_the_same_bits_on_any_number_of_threads(config, detector):
    run = SearchRun(config)
    finish(run, "searching")
    (file,) = (config.cache / "looks").rglob("*.safetensors")
    content = file.read_bytes()
    file.unlink()
    torch.set_num_threads(4)
    again = SearchRun(config)
    again.detections(0)
    assert torch.get_num_threads() == 4
    assert file.read_bytes() == content


def test_the_same_policy_twice_is_refused(config):
    for policies in (("random", "random"), ("random", PolicyConfig("random")), ("recommended", "target-evidence")):
        with pytest.raises(InputError, match=r"^policies: expected each policy once, got '.*' 2 times"):
            SearchRun(replace(config, policies=policies))


@pytest.mark.slow
def test_a_changed_choice_changes_the_printed_result(tmp_path):
    """The same command and folder, with the choice of the next cell turned round in between."""
    tree = tmp_path / "tree"
    for name in ("semfov", "eval"):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    small = ["--data.limit", "1", "--belief.columns", "4", "--belief.rows", "3", "--protocol.starts", "3"]
    small += ["--protocol.shifts", "5", "--policies", '["target-evidence"]', "--scanpaths", "0", "--workers", "1"]

    def search(out):
        call = [sys.executable, "-m", "eval.search", *small, "--out", str(out), "--cache", str(tmp_path / "cache")]
        environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(call, cwd=tree, env=environment, capture_output=True, text=True, check=True)
        return (out / "episodes.jsonl").read_text(), done.stderr

    # The first of them here: the tree has the same code.
    assert main([*small, "--out", str(tmp_path / "out"), "--cache", str(tmp_path / "cache")]) == 0
    first = (tmp_path / "out" / "episodes.jsonl").read_text()
    choice = tree / "semfov" / "gaze" / "selection.py"
    text = choice.read_text()
    assert "masked_fill(visited, -torch.inf)" in text
    choice.write_text(text.replace("masked_fill(visited, -torch.inf)", "neg().masked_fill(visited, -torch.inf)"))
    second, told = search(tmp_path / "out")
    assert "by another version of the code" in told
    assert second != first
    assert search(tmp_path / "fresh")[0] == second


def test_records_come_from_the_parts_of_this_code_alone(config, monkeypatch):
    run = SearchRun(config)
    finish(run, "searching")
    assert gather(run)[0]
    monkeypatch.setattr(run_module, "versions", lambda: {"torch": "another"})
    other = SearchRun(config)
    assert other.parts.load(0) is None
