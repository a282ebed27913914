"""`python -m eval.calibration` as a user runs it: small, on the embedded scenes, with the real detector."""

import csv
import json

import pytest
import torch

from eval.calibration import main
from semfov.belief import MapEvidence, TargetEvidence
from semfov.metrics.calibration import BinarySums
from semfov.runs.config import DetectorConfig, SensorConfig
from semfov.runs.setup import make_eye

BELIEFS = ["raw", "calibrated", "tempered", "learned", "learned map"]
FILES = ("beliefs.md", "beliefs.csv", "beliefs.json")


@pytest.fixture(scope="module")
def arguments(tmp_path_factory):
    """Arguments of a run of two scenes on 5 × 4 cells with untrained models."""
    folder = tmp_path_factory.mktemp("calibration")
    settings = make_eye(DetectorConfig(), SensorConfig()).settings()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        TargetEvidence(8, 6, metadata=settings).save(folder / "target.safetensors")
        MapEvidence(8, 6, metadata=settings).save(folder / "map.safetensors")
    return [
        "--data.limit", "2", "--fixations", "1", "--grid", "[5,4]", "--target_area", "0.5",
        "--target_model", str(folder / "target.safetensors"), "--map_model", str(folder / "map.safetensors"),
        "--cache", str(folder / "cache"),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def finished(arguments, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert main([*arguments, "--workers", "1", "--out", str(out)]) == 0
    return out


@pytest.mark.weights
def test_run_writes_tables_sums_and_figures(finished):
    for name in ("calibration.md", "config.yaml", "reliability.png", "beliefs.png", *FILES):
        assert (finished / name).stat().st_size > 200
    rows = list(csv.DictReader((finished / "beliefs.csv").read_text().splitlines()))
    whole = [row for row in rows if row["cells"] == "all"]
    assert [(row["belief"], row["looks"]) for row in whole] == [(b, n) for b in BELIEFS for n in ("1", "5", "15")]
    # Two scenes, each with a present and an absent class: 4 searches of 20 cells.
    assert {row["count"] for row in whole} == {"80"}
    assert {row["count"] for row in rows if (row["looks"], row["cells"]) == ("15", "fixated")} == {"60"}
    text = (finished / "beliefs.md").read_text()
    assert "4 searches" in text
    assert "2 of them for a class that is present" in text
    assert "half of the target classes are present" in text
    by_looks = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"]
    for row in whole:
        figures = [f"{float(row[name]):.4f}" for name in ("nll", "brier", "ece", "mean_probability", "rate")]
        shown = next(line for line in by_looks if line[:2] == [row["looks"], row["belief"]])
        assert [float(value) for value in shown[3:]] == pytest.approx([float(f) for f in figures], abs=1.01e-4)


@pytest.mark.weights
def test_sums_in_the_file_add_up_to_the_figures(finished):
    written = json.loads((finished / "beliefs.json").read_text())
    assert written["edges"] == BinarySums.EDGES.tolist()
    rows = list(csv.DictReader((finished / "beliefs.csv").read_text().splitlines()))
    assert len(rows) == len(written["sums"])
    for row, each in zip(rows, written["sums"], strict=True):
        assert (row["belief"], int(row["looks"]), row["cells"]) == (each["belief"], each["looks"], each["cells"])
        sums = BinarySums.from_record(each)
        assert (float(row["nll"]), float(row["ece"])) == pytest.approx((sums.nll, sums.ece), abs=1e-6)
        parts = [s for s in written["sums"] if (s["belief"], s["looks"]) == (each["belief"], each["looks"])]
        if each["cells"] == "all":
            assert sums.count == sum(BinarySums.from_record(s).count for s in parts) / 2
