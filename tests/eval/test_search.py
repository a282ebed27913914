"""`python -m eval.search` as a user runs it: small, on the embedded scenes, with the real detector."""

import csv
import json
import os
import re
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
import yaml

from eval.search import main, search
from semfov.experiments.config import BeliefConfig, DataConfig, PolicyConfig, ProtocolConfig, SearchConfig
from semfov.experiments.looks import see_all
from semfov.experiments.presets import label, presets
from semfov.experiments.runs import SearchRun
from semfov.experiments.store import DetectionStore
from semfov.gaze.policies import POLICIES

pytestmark = pytest.mark.weights

RECORDS = ("episodes.jsonl", "summary.csv")


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A run of two scenes on 4 × 3 cells."""
    folder = tmp_path_factory.mktemp("search")
    return SearchConfig(
        data=DataConfig(limit=2),
        belief=BeliefConfig(columns=4, rows=3),
        protocol=ProtocolConfig(starts=3, shifts=6),
        policies=("random", "itti-koch", PolicyConfig("non-predictive", tempering=0.25), "non-predictive-raw"),
        cache=folder / "cache",
        out=folder / "out",
        workers=1,
        scanpaths=1,
    )


@pytest.fixture(scope="session")
def finished(small):
    """The small run, finished."""
    threads = torch.get_num_threads()
    search(small)
    torch.set_num_threads(threads)
    return small


def records_of(config: SearchConfig) -> list[bytes]:
    return [(config.out / name).read_bytes() for name in RECORDS]


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


@pytest.mark.parametrize(
    "change",
    [{"store": False}, {"workers": 2}, {"protocol": ProtocolConfig(starts=3, shifts=6, batch=2)}],
    ids=["without the store", "two workers", "small batches"],
)
def test_records_do_not_depend_on_the_store_the_workers_or_the_batch_size(finished, change, tmp_path):
    again = replace(finished, out=tmp_path / "out", cache=tmp_path / "cache", **change)
    search(again)
    assert records_of(again) == records_of(finished)


@pytest.mark.usefixtures("one_thread")
def test_stored_looks_equal_new_looks_and_damaged_files_are_refused(finished):
    run = SearchRun(finished)
    digest = run.scenes.digest(0)
    stored = run.store.load(digest)
    seen = see_all(run.eye, run.scenes[0].image, run.grid(0))
    for name in ("boxes", "scores", "mask"):
        assert torch.equal(getattr(stored, name), getattr(seen, name))
    path = run.store.path(digest)
    whole = path.read_bytes()
    for damage in (whole[: len(whole) // 2], b"", whole[:-40] + bytes([whole[-40] ^ 1]) + whole[-39:]):
        path.write_bytes(damage)
        assert run.store.load(digest) is None
    path.write_bytes(whole)
    other = DetectionStore(path.parent.parent, {"another": "eye"}, 4, 3)
    other.folder = run.store.folder
    assert other.load(digest) is None


def test_damaged_parts_are_computed_again(finished, tmp_path):
    again = replace(finished, out=tmp_path)
    search(again)
    part = next((tmp_path / "parts").glob("*/000001.json"))
    part.write_text(part.read_text().replace('"repetition": 1', '"repetition": 2', 1))
    search(again)
    assert records_of(again) == records_of(finished)


def as_mapping(policy: PolicyConfig) -> dict:
    """A policy as the mapping that a user would write."""
    return {name: value for name, value in asdict(policy).items() if value is not None}


def command(config: SearchConfig, out: Path, cache: Path, *more: str) -> list[str]:
    policies = [choice if isinstance(choice, str) else as_mapping(choice) for choice in config.policies]
    return [
        sys.executable, "-m", "eval.search", "--data.limit", "2", "--belief.columns", "4", "--belief.rows", "3",
        "--protocol.starts", "3", "--protocol.shifts", "6", "--policies", json.dumps(policies),
        "--out", str(out), "--cache", str(cache), "--workers", "1", "--scanpaths", "0", *more,
    ]  # fmt: skip


@pytest.mark.slow
def test_killed_run_resumes_with_the_same_result(finished, tmp_path, kill_when):
    call = command(finished, tmp_path / "out", tmp_path / "cache")
    root = Path(__file__).parents[2]
    kill_when(call, lambda: list(tmp_path.glob("out/parts/*/*.json")), cwd=root)
    assert not (tmp_path / "out/summary.csv").exists()
    threads = torch.get_num_threads()
    assert main(call[3:]) == 0
    torch.set_num_threads(threads)
    again = replace(finished, out=tmp_path / "out")
    assert records_of(again) == records_of(finished)


@pytest.mark.slow
def test_torchrun_ranks_share_the_work(finished, tmp_path):
    call = command(finished, tmp_path / "out", tmp_path / "cache")
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [*launch, *call[1:]], cwd=Path(__file__).parents[2], check=True, capture_output=True, env=environment
    )
    assert records_of(replace(finished, out=tmp_path / "out")) == records_of(finished)


def test_wrong_policies_and_detectors_are_reported_in_one_line(capsys, tmp_path):
    assert main(["--policies", '["predicitve-raw"]', "--out", str(tmp_path)]) == 1
    assert "did you mean 'predictive-raw'" in capsys.readouterr().err
    assert main(["--detector.name", "yolov3-tinny", "--out", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "yolov3-tiny" in error
    assert error.count("\n") == 1


def test_unwritable_output_is_named(capsys, tmp_path, small):
    blocked = tmp_path / "file"
    blocked.write_text("")
    arguments = command(small, blocked / "out", small.cache)[3:]
    assert main(arguments) == 1
    assert str(blocked) in capsys.readouterr().err


def test_unknown_keys_are_refused(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--sensor.sigmma", "3"])
    assert stopped.value.code == 2
    assert "sigmma" in capsys.readouterr().err


def test_help_and_print_config(capsys):
    with pytest.raises(SystemExit) as stopped:
        main(["--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    for word in ("--sensor.sigma", "width of the fovea", "--config"):
        assert word in text
    explained = "".join(re.search(r"--policies \[ITEM.*?\(type:", text, re.DOTALL)[0].split())
    for name, preset in presets("search").items():
        if preset.policy in POLICIES and not POLICIES[preset.policy].__module__.startswith("semfov."):
            continue  # a policy registered by another test
        alone = re.sub("-(raw|calibrated|learned)$", "", name)
        assert f"`{alone}`" in explained, name
    assert "`-raw`or`-calibrated`" in explained
    assert "Thelastfouralsotake`-learned`" in explained
    learned = [name for name in presets("search") if name.endswith("-learned")]
    assert learned == [
        "foveal-hit-learned",
        "place-information-learned",
        "entropy-limit-learned",
        "ideal-observer-learned",
        "maximum-a-posteriori-learned",
    ]
    with pytest.raises(SystemExit):
        main(["--sensor.sigma", "50", "--print_config"])
    printed = yaml.safe_load(capsys.readouterr().out)
    assert printed["sensor"]["sigma"] == 50


def test_the_example_of_a_policy_in_the_help_is_valid(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = " ".join(capsys.readouterr().out.replace("-\n", "-").split())
    mapping = re.search(r"mapping of settings such as `(\{.*?\})`", text)[1]
    with pytest.raises(SystemExit):
        main(["--policies", f"[{mapping}]", "--print_config"])
    (policy,) = yaml.safe_load(capsys.readouterr().out)["policies"]
    assert label(PolicyConfig(**policy), "search") == "non-predictive-calibrated, tempering 0.25"
    with pytest.raises(SystemExit):
        main(["--policies.help"])
    settings = capsys.readouterr().out
    for name in asdict(PolicyConfig("random")):
        assert name in settings
