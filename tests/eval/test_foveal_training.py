"""`python -m eval.foveal_training` as a user runs it: small, on the embedded scenes, with the real detector."""

import json

import numpy as np
import pytest
import torch

from eval.calibration import main as calibrate
from eval.foveal_training import main
from eval.search import main as search
from semfov.detection.export import export_onnx
from semfov.detection.load import load_yolo
from semfov.metrics.search import cumulative_performance
from semfov.training.foveal_comparison import curves_of

pytestmark = [pytest.mark.weights, pytest.mark.slow]

PHOTOGRAPHS = ["--data.limit", "2", "--data.min_instances", "1", "--data.max_target_area", "0.5"]
PROTOCOL = ["--protocol.starts", "2", "--protocol.shifts", "6", "--workers", "1"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A comparison of YOLOv3-tiny with a copy of lower scores, on two scenes of 5 × 4 cells."""
    out = tmp_path_factory.mktemp("compared")
    detector = load_yolo("yolov3-tiny", runtime="torch")
    for number in (15, 22):
        detector.network.layers[number].bias[4::85] -= 2
    detector.name = "unsure"
    export_onnx(detector, out / "tuned" / "unsure.onnx")
    epochs = [{"seconds": 30.0}, {"seconds": 60.0}]
    (out / "tuned" / "training.json").write_text(json.dumps({"looking_seconds": 90.0, "epochs": epochs}))
    arguments = [
        "--tuned", str(out / "tuned" / "unsure.onnx"), "--fit.limit", "3", "--grid", "[5,4]", "--fixations", "2",
        "--cache", str(out / "cache"), "--out", str(out / "compared"), *PHOTOGRAPHS, *PROTOCOL,
    ]  # fmt: skip
    threads = torch.get_num_threads()
    assert main(arguments) == 0
    torch.set_num_threads(threads)
    return out, arguments


def tables(out):
    """The rows of every table, by their first cell."""
    found = []
    for part in (out / "compared" / "foveal_training.md").read_text().split("\n\n"):
        rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines() if line[:1] == "|"]
        if rows:
            found.append({row[0]: row[1:] for row in rows})
    return found


ARMS = ["as shipped, raw", "calibrated", "fine-tuned, raw", "fine-tuned and calibrated"]


def test_the_report_has_six_tables_of_four_arms(finished):
    effort, recall, calibration, surprise, performance, differences = tables(finished[0])
    for found in (effort, recall, calibration, surprise):
        assert [name for name in found if name in ARMS] == ARMS
    assert list(performance)[-1] == "random gaze, by formula"
    assert "calibrated" not in differences
    assert [effort[name][0] for name in ARMS] == ["0", "0", "3.0", "3.0"]
    counts = [int(cell) for cell in recall["objects"]]
    assert sum(counts[:-1]) == counts[-1] > 10


def test_a_less_confident_detector_keeps_fewer_boxes(finished):
    detections = {name: int(row[0]) for name, row in tables(finished[0])[2].items() if name in ARMS}
    assert detections["fine-tuned, raw"] < detections["as shipped, raw"] == detections["calibrated"]


def test_calibration_matches_eval_calibration(finished, tmp_path):
    """The same photographs, fixations and models, with the command that evaluates only scores."""
    out, _ = finished
    arguments = [
        "--data.limit", "2", "--data.min_instances", "1", "--data.max_target_area", "0.5", "--fixations", "2",
        "--model", str(out / "compared" / "shipped" / "observation.safetensors"), "--beliefs", "false",
        "--workers", "1", "--out", str(tmp_path),
    ]  # fmt: skip
    assert calibrate(arguments) == 0
    lines = (tmp_path / "calibration.md").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("| all")]
    ours = tables(out)[2]
    for row, name in zip(rows, ARMS[:2], strict=True):
        count, _, *figures = ours[name]
        assert [count, *figures] == row[2:]


def test_searches_match_eval_search(finished, tmp_path):
    out, _ = finished
    for detector, names in (("shipped", ARMS[:2]), ("tuned", ARMS[2:])):
        arguments = [
            "--belief.columns", "5", "--belief.rows", "4", "--cache", str(out / "cache"), "--scanpaths", "0",
            "--policies", "[non-predictive-raw, non-predictive-calibrated]", "--out", str(tmp_path / detector),
            "--belief.model", str(out / "compared" / detector / "observation.safetensors"), *PHOTOGRAPHS, *PROTOCOL,
            *(["--detector.name", str(out / "tuned" / "unsure.onnx")] if detector == "tuned" else []),
        ]  # fmt: skip
        assert search(arguments) == 0
        head, *rows = (tmp_path / detector / "summary.csv").read_text().splitlines()
        columns = head.split(",")
        for name, policy in zip(names, ("non-predictive-raw", "non-predictive-calibrated"), strict=True):
            found = {}
            for row in rows:
                cells = dict(zip(columns, row.split(","), strict=True))
                if (cells["average"], cells["policy"]) == ("all targets", policy):
                    found[int(cells["shifts"])] = 100 * float(cells["performance"])
            ours = [float(cell.split(" ")[0]) for cell in tables(out)[4][name]]
            assert ours == pytest.approx([found[1], found[5]], abs=0.06)


def test_repeating_the_command_computes_nothing_again(finished):
    out, arguments = finished
    before = {path: path.stat().st_mtime_ns for path in (out / "compared").rglob("*.safetensors")}
    text = (out / "compared" / "foveal_training.md").read_text()
    assert main(arguments) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "compared").rglob("*.safetensors")} == before
    assert (out / "compared" / "foveal_training.md").read_text() == text


def test_searches_may_use_fewer_photographs_than_the_other_measures(finished):
    out, arguments = finished
    assert main([*arguments, "--searched", "1"]) == 0
    text = (out / "compared" / "foveal_training.md").read_text()
    assert "search (1 photographs" in text
    assert "longer side (2 photographs" in text


def test_there_is_one_curve_for_each_photograph():
    curves = curves_of({"b": [1, -1], "a": [0, 2, 2]}, 2)
    np.testing.assert_allclose(curves, [cumulative_performance(np.array(f), 2) for f in ([0, 2, 2], [1, -1])])


def test_a_missing_detector_names_the_command_that_makes_it(tmp_path, capsys):
    assert main(["--tuned", str(tmp_path / "none.onnx"), "--out", str(tmp_path)]) == 1
    assert "make it with python -m train.finetune_foveal" in capsys.readouterr().err
