"""The experiment with a head that turns: results with and without a store, resuming, and tables."""

import json
import sqlite3
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
import torch

from eval.head import report as head_report
from eval.head.run import HeadConfig, HeadRun, _scene_answers, _tiling_order
from semfov import MapEvidence, TargetEvidence
from semfov.data.scene import Annotation, Scene
from semfov.head.views import Views
from tests.small import Tiles


class NoiseScenes:
    """Five pictures of coloured noise, each with one box."""

    classes, ids, fingerprint = ("person", "cat", "cup"), [0, 1, 2, 3, 4], "noise"

    def __len__(self):
        return 5

    def __getitem__(self, index):
        image = torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(index))
        annotation = self.annotation(index)
        return Scene(index, f"noise {index}", image, annotation.boxes, annotation.labels)

    def annotation(self, index):
        boxes = torch.tensor([[8.0 * index, 10, 8.0 * index + 20, 30]])
        return Annotation(boxes, torch.tensor([1 + index % 3]), torch.zeros(1, dtype=torch.bool), (64, 48))

    def targets(self, index):
        return [1 + index % 3]

    def digest(self, index):
        return f"noise {index}"


@pytest.fixture(params=["panorama", "mosaic"])
def config(request, tmp_path, monkeypatch):
    monkeypatch.setattr("semfov.runs.setup.load_detector", lambda name, **options: Tiles())
    monkeypatch.setattr("eval.head.run.make_scenes", lambda data, classes: NoiseScenes())
    torch.manual_seed(0)
    models = TargetEvidence(components=4).requires_grad_(False), MapEvidence(components=4).requires_grad_(False)
    monkeypatch.setattr("eval.head.run.make_learned", lambda kind, name, eye: {type(m): m for m in models}[kind])
    return HeadConfig(
        scene=request.param,
        scenes=2,
        targets=1,
        width=256,
        passes=4,
        seconds=3.0,
        out=tmp_path / "out",
        cache=tmp_path / "cache",
        workers=1,
    )


@pytest.mark.slow
def test_tables_match_records_and_a_deleted_part_is_computed_again(config, capsys):
    head_report.head(config)
    text = (config.out / "head.md").read_text()
    assert text in capsys.readouterr().out
    records = [json.loads(line) for line in (config.out / "records.jsonl").read_text().splitlines()]
    assert {record["task"] for record in records} == {"search", "exploration"}
    for record in records:
        assert len(record["actions"]) <= config.passes
        assert f"| {record['way']} " in text
        if record["task"] == "search":
            assert record["seconds"] <= config.seconds
            assert record["passes"] == len(record["actions"])
        else:
            assert len(record["seconds"]) == len(record["success"]) == len(record["objects"])
            assert max(record["success"] + record["objects"]) <= 1
    (parts,) = (config.out / "parts").rglob("*.sqlite")
    with closing(sqlite3.connect(parts)) as database, database:
        before = database.execute("SELECT * FROM scenes WHERE number > 0").fetchall()
        database.execute("DELETE FROM scenes WHERE number = 0")
    head_report.head(config)
    with closing(sqlite3.connect(parts)) as database:
        assert database.execute("SELECT * FROM scenes WHERE number > 0").fetchall() == before
        assert database.execute("SELECT COUNT(*) FROM scenes").fetchone()[0] == len(before) + 1
    assert (config.out / "head.md").read_text() == text


@pytest.mark.slow
def test_all_ways_start_at_the_same_view_and_the_eye_alone_never_turns_the_head(config):
    for task in ("search", "exploration"):
        records = [record for record in HeadRun(config).outcomes(1)[0] if record["task"] == task]
        assert len({record["actions"][0] for record in records}) == 1
        (alone,) = (record for record in records if record["way"] == "eye alone")
        assert len({action // 100 for action in alone["actions"]}) == 1


def test_a_raster_scan_visits_every_view_of_the_tiling(config):
    run = HeadRun(config)
    views = Views(run.world(0))
    order = _tiling_order(views, views.tiling[0][1][1])
    assert order[0] == views.tiling[0][1][1]
    assert sorted(order) == sorted(pose for row in views.tiling[0] for pose in row)
    steps = [float(views.world.turn(views.poses[a], views.poses[b])) for a, b in pairwise(order)]
    assert np.median(steps) <= 60.1


def test_answers_lie_in_reachable_cells_inside_boxes(config):
    run = HeadRun(config)
    views, places, labels = Views(run.world(0)), run.places(0), run.scenes.annotation(0).labels
    answers = _scene_answers(views, places, labels, 3)
    inside = places.contain(views.world.centres)
    for cell in range(0, len(views.world.scene), 11):
        held = set(labels[inside[:, cell]].tolist()) if views.reachable[cell] else set()
        assert held <= set(answers[cell].nonzero()[:, 0].tolist())
    assert not answers[~views.reachable].any()
    assert not answers[:, 0].any()


def test_means_and_paired_differences_match_hand_calculations():
    ours = [{"scene": 0, "v": 1.0}, {"scene": 0, "v": 3.0}, {"scene": 1, "v": 6.0}]
    others = [{"scene": 0, "v": 5.0}, {"scene": 1, "v": 7.0}]
    mean, error, apart, error_apart = head_report.compared(others, ours, lambda record: record["v"])
    assert (mean, apart) == (6.0, 2.0)  # 5 and 7; 5 - 2 and 7 - 6
    assert error == pytest.approx(np.std([5, 7], ddof=1) / np.sqrt(2))
    assert error_apart == pytest.approx(np.std([3, 1], ddof=1) / np.sqrt(2))
    record = {"seconds": [0.5, 1.0, 2.0], "success": [0.1, 0.2, 0.4]}
    assert [head_report._value_by(record, s, "success") for s in (0.2, 0.5, 1.9, 9.0)] == [0.0, 0.1, 0.2, 0.4]
