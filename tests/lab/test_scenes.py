"""The experiments with large pictures and with a head: results with and without a store, orders of looks, tables."""

import json
import sqlite3
from contextlib import closing
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torchvision.ops import batched_nms

from eval.bootstrap import Bootstrap
from eval.head import report as head_report
from eval.head.run import HeadConfig, HeadRun, _scene_answers, _tiling_order
from eval.zoom import report as zoom_report
from eval.zoom.decisions import decision_tables
from eval.zoom.objects import (
    Returned,
    average_precision,
    class_mean,
    expected_of,
    in_all_table,
    object_figures,
    object_record,
    suppressed,
)
from eval.zoom.orders import in_order, quad_tree, shuffled
from eval.zoom.report import _recall_cells, recall_and_precision
from eval.zoom.run import ZoomConfig, ZoomRun
from semfov import FovealObservationModel
from semfov.data.scene import Annotation, Scene
from semfov.detection import Detections, Objects
from semfov.head.views import Views
from semfov.paths import ZoomPath
from semfov.runs.config import DataConfig
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.certainty import SPREAD
from semfov.zoom.episode import look_by_look
from semfov.zoom.looks import WindowLook
from semfov.zoom.slices import ranked, slices
from tests.small import Tiles, cells_of

pytestmark = pytest.mark.usefixtures("few_samples")


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
    classes = ["red", "green", "blue"]
    searching = FovealObservationModel.identity(classes, [0.2], miss_odds=torch.full((4, 2), 0.3)).requires_grad_(False)
    observation = FovealObservationModel.identity(classes, [0.2]).requires_grad_(False)
    monkeypatch.setattr("eval.head.run.make_searching", lambda name, eye: searching)
    monkeypatch.setattr("eval.head.run.make_map", lambda name, eye: observation)
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
    order = _tiling_order(views, views.tiling[1][1])
    assert order[0] == views.tiling[1][1]
    assert sorted(order) == sorted(pose for row in views.tiling for pose in row)
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


@pytest.fixture
def zooming(tmp_path, monkeypatch):
    monkeypatch.setattr("semfov.runs.setup.load_detector", lambda name, **options: Tiles())
    torch.manual_seed(0)
    GlimpseEvidence(3).save(tmp_path / "model.safetensors")
    return ZoomConfig(
        data=DataConfig(limit=5, min_instances=0, max_target_area=None),
        mosaics=2,
        columns=2,
        rows=2,
        tile=320,
        passes=6,
        model=str(tmp_path / "model.safetensors"),
        out=tmp_path / "out",
        cache=tmp_path / "cache",
        workers=1,
    )


@pytest.mark.slow
def test_results_do_not_depend_on_the_store(zooming):
    fresh = ZoomRun(replace(zooming, store=False)).outcomes(0)[0]
    written = ZoomRun(zooming).outcomes(0)[0]
    run = ZoomRun(zooming)
    run.eye.detect = None  # any new look would fail
    assert run.outcomes(0)[0] == written == fresh


@pytest.mark.slow
def test_tables_match_records(zooming, capsys):
    zoom_report.zoom(zooming)
    text = (zooming.out / "zoom.md").read_text()
    assert text in capsys.readouterr().out
    for way in ("slices, raster", "quad-tree, best first", "semfov", "oracle"):
        assert f"| {way} " in text
    records = [json.loads(line) for line in (zooming.out / "records.jsonl").read_text().splitlines()]
    for record in records:
        if record["measure"] == "recall":
            assert len(record["found"]) <= zooming.passes
            assert max(record["found"]) <= record["objects"]
        elif record["measure"] == "decision":
            assert record["passes"] <= zooming.passes
            assert 0 <= record["probability"] <= 1
        elif record["measure"] == "objects":
            assert all(len(found["scores"]) == len(found["right"]) for found in record["after"].values())
            # The evidence of this run has no certainty.
            assert all(found["in all"] is None for found in record["after"].values())
        else:
            assert 1 <= record["passes"] <= 5


@pytest.mark.slow
def test_measures_can_be_left_out(zooming, capsys):
    zoom_report.zoom(replace(zooming, measures=("decision", "objects")))
    text = capsys.readouterr().out
    assert "Is the target present?" in text
    assert "| semfov, scores of the detector " in text
    assert "Recall" not in text
    assert {json.loads(line)["measure"] for line in (zooming.out / "records.jsonl").read_text().splitlines()} == {
        "decision",
        "objects",
    }


def test_the_number_in_all_is_compared_with_the_annotated_one():
    """5 and 3 are expected where there are 4 each after a pass, 4 and 2 after more."""
    numbers = [((5.0, 0.5), (4.0, 1.0)), ((3.0, 0.4), (2.0, 1.0))]
    ours = [
        {
            "objects": 4,
            "after": {
                n: {"in all": mean, "error": error, "given": mean > 3}
                for n, (mean, error) in zip("14", each, strict=True)
            },
        }
        for each in numbers
    ]
    others = [{"objects": 4, "after": {"1": {"in all": None}, "4": {"in all": None}}}]
    text = in_all_table([*others, *ours], ["1", "4"])
    rows = cells_of("\n".join(text))
    assert rows[-5:-3] == [["expected in all", "4.0", "3.0"], ["off by", "1.0", "1.0"]]
    assert rows[-3:-1] == [["its error", "0.5", "1.0"], ["within two errors", "0.50", "1.00"]]
    assert rows[-1] == ["number given", "1", "1"]
    assert "There are 4.0 in the mean." in text[0]
    assert in_all_table(others, ["1", "4"]) == []


def test_figures_of_objects_match_hand_calculations():
    """Two pictures with two objects each: three right boxes and one wrong one, of which three are listed."""
    none = {"scores": [], "right": [], "labels": [], "listed": 0, "listed right": 0, "kept": 0}
    found = [([0.9, 0.6], [1, 0], [1, 2], 2, 1), ([0.8, 0.1], [1, 1], [1, 1], 1, 1)]
    records = [
        {"objects": 2, "by class": counts, "plain": 2, "after": {"1": none, "4": dict(zip(none, after, strict=False))}}
        for after, counts in zip(found, ({"1": 1, "2": 1}, {"1": 2}), strict=True)
    ]
    assert class_mean(records, "4") == pytest.approx((1 + 0) / 2)
    measure = object_figures({"semfov": records}, ["1", "4"])
    none, precision, *figures = measure(torch.arange(2))[0].tolist()
    assert none == 0
    # Precision 1 up to a recall of 2 / 4, 3 / 4 up to 3 / 4, and 0 beyond it.
    assert precision == pytest.approx((51 + 25 * 0.75) / 101)
    ece = (abs(0.9 - 1) + abs(0.6 - 0) + abs(0.8 - 1) + abs(0.1 - 1)) / 4
    assert figures == pytest.approx([2 / 3, 2 / 4, 3 / 4, (0 + 1) / 2, (0.5 + 1.1) / 2, ece])
    drawn = torch.tensor([1, 0, 1])
    torch.testing.assert_close(
        measure(drawn), object_figures({"semfov": [records[n] for n in drawn]}, ["1", "4"])(torch.arange(3))
    )


def test_plain_suppression_equals_that_of_torchvision():
    """Of the boxes of two looks that no border cuts, class by class."""
    generator = torch.Generator().manual_seed(0)
    corners = 60 * torch.rand(2, 1, 40, 2, generator=generator)
    boxes = torch.cat([corners, corners + 5 + 20 * torch.rand(2, 1, 40, 2, generator=generator)], -1)
    scores, cut = torch.rand(2, 1, 40, 3, generator=generator), torch.rand(2, 40, generator=generator) < 0.3
    looks = [
        WindowLook(None, Detections(*each[:2], torch.ones(1, 40).bool()), each[2], None, None)
        for each in zip(boxes, scores, cut, strict=True)
    ]
    whole, value = boxes.flatten(0, 2)[~cut.flatten()], scores.flatten(0, 2)[~cut.flatten()]
    for target, (best, label) in {None: value[:, 1:].max(-1), 2: (value[:, 2], torch.ones(len(value)))}.items():
        kept = batched_nms(whole, best, label, 0.5)
        found = suppressed(looks, target).objects
        torch.testing.assert_close(found.boxes, whole[kept])
        torch.testing.assert_close(found.labels, label[kept].long() + 1)


def test_boxes_of_a_plain_pass_are_kept_where_one_of_their_class_is_listed():
    boxes, nothing = torch.tensor([[0.0, 0, 9, 9], [20, 20, 30, 30], [50, 0, 60, 9]]), torch.zeros(3).long()
    plain = Objects(boxes, torch.full((3,), 0.6), torch.tensor([1, 2, 1]), nothing)
    listed = Objects(boxes + 1, torch.full((3,), 0.9), torch.tensor([1, 1, 1]), nothing)
    truth = Annotation(boxes, torch.tensor([1, 2, 2]), torch.tensor([False, False, True]), (80, 60))
    record = object_record("semfov", {4: Returned(listed, listed[:2], (1.0, 0.25))}, truth, plain)
    after = record["after"]["4"]
    assert (record["objects"], record["by class"], record["plain"]) == (2, {"1": 1, "2": 1}, 3)
    assert (after["listed"], after["listed right"], after["kept"]) == (2, 1, 1)
    # Objects hide together: those that are listed vary twice as much as independent ones.
    variance = 2 * 3 * 0.09 + 0.25 + (SPREAD * 3.7) ** 2
    assert (after["in all"], after["error"]) == pytest.approx((3.7, variance**0.5))


def test_a_number_is_given_where_the_record_has_one_also_where_nothing_is_listed():
    """In a photograph without a cup none is expected, with an error of one; the faint ones count twice."""
    nothing = Objects(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0).long(), torch.zeros(0).long())
    lattice, names = Lattice.over((300, 200), (416, 416)), ("background", "cup", "cat")
    path = ZoomPath(lattice=lattice, classes=names, target=1, looks=(), candidates=nothing, unseen=(0.0, 0.0))
    truth = Annotation(torch.zeros(0, 4), torch.zeros(0).long(), torch.zeros(0).bool(), (300, 200))
    after = object_record("semfov", {1: expected_of(path)}, truth, nothing)["after"]["1"]
    assert (after["given"], after["in all"], after["error"]) == (True, 0.0, 1.0)
    boxes = torch.tensor([[0.0, 0, 9, 9], [20, 20, 30, 30]])
    faint = Objects(boxes, torch.tensor([0.3, 0.1]), torch.tensor([1, 1]), torch.zeros(2).long())
    after = object_record("semfov", {1: expected_of(replace(path, candidates=faint))}, truth, nothing)["after"]["1"]
    assert after["given"]
    assert after["in all"] == pytest.approx(0.8)
    assert after["error"] == pytest.approx((0.21 + 0.09 + 1.8**2) ** 0.5)
    large = replace(path, lattice=Lattice.over((4000, 3000), (416, 416)), candidates=faint)
    assert not expected_of(large).given


def test_average_precision_equals_that_of_coco():
    """Boxes in a row, far from each other, so that a box is right or not."""
    coco, evaluation = pytest.importorskip("pycocotools.coco"), pytest.importorskip("pycocotools.cocoeval")
    generator = torch.Generator().manual_seed(0)
    right, scores = torch.rand(40, generator=generator) < 0.6, torch.rand(40, generator=generator)
    truth = coco.COCO()
    box = {"image_id": 1, "category_id": 1}
    places = [[20.0 * n, 0.0, 10.0, 10.0] for n in range(60)]
    objects = [*places[:40], *places[50:]]
    truth.dataset = {
        "images": [{"id": 1}],
        "categories": [{"id": 1}],
        "annotations": [
            box | {"id": n + 1, "bbox": place, "area": 100, "iscrowd": 0} for n, place in enumerate(objects)
        ],
    }
    truth.createIndex()
    seen = [
        box | {"bbox": place if hit else [place[0], 500.0, 10.0, 10.0], "score": score}
        for place, hit, score in zip(places, right.tolist(), scores.tolist(), strict=False)
    ]
    judge = evaluation.COCOeval(truth, truth.loadRes(seen), "bbox")
    judge.evaluate()
    judge.accumulate()
    theirs = judge.eval["precision"][0, :, 0, 0, -1].mean()
    assert average_precision(scores, right, len(objects)) == pytest.approx(theirs, abs=1e-6)


def test_tables_of_decisions_match_hand_calculations():
    """Two searches for a target that is present and two for one that is absent."""
    common = {"measure": "decision", "way": "semfov", "count": 17, "overview": 0.1, "slices": 0.2}
    common |= {"scene": 3, "frequency": 0.3}
    records = [
        common | {"present": there, "outcome": outcome, "probability": p, "passes": passes, "overlap": overlap}
        for there, outcome, p, passes, overlap in (
            (True, "found", 0.95, 3, 0.8),
            (True, "found", 0.85, 5, 0.1),
            (False, "absent", 0.05, 10, None),
            (False, "undecided", 0.6, 24, None),
        )
    ]
    text = "\n".join(decision_tables(records))
    cells = {
        row[1].strip(): [cell.strip() for cell in row[2:-1]]
        for row in (line.split("|") for line in reversed(text.splitlines()))
        if len(row) > 3
    }
    assert cells["it is there"] == ["100.0", "50.0 (50.0 to 50.0)", "0.0", "0.0", "4.0", "0.90"]
    assert cells["it is not"][:5] == ["0.0", "", "50.0", "50.0", "17.0"]
    assert cells["semfov"][:2] == ["10.5", "1.000 ± 0.000"]
    assert cells["all slices, highest score"][:2] == ["17.0", "0.500 ± 0.000"]
    assert cells["class frequency"][:2] == ["-", "0.500 ± 0.000"]
    # With closer looks, one of the finds is absent.
    changed = [record | {"way": "semfov, without closer looks"} for record in records]
    records[0] = records[0] | {"outcome": "absent", "overlap": None, "probability": 0.3}
    text = "\n".join(decision_tables([each for pair in zip(records, changed, strict=True) for each in pair]))
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.count("|") > 3]
    rows = {line[0]: line[1:] for line in reversed(lines)}
    assert rows["it is there"] == ["50.0", "0.0 (0.0 to 0.0)", "50.0", "0.0", "4.0", "0.57"]
    assert rows["it is there, without closer looks"] == cells["it is there"]
    assert rows["semfov, without closer looks"] == cells["semfov"]
    assert rows["semfov"][1] == "0.750 ± 0.000"
    start = next(number for number, line in enumerate(lines) if line[0] == "difference to semfov")
    name, area, *hits, right = lines[start + 2]
    assert (name, area) == ("semfov, without closer looks", "+0.250 ± 0.000")
    assert hits == ["+50 (+50 to +50)"] * 3
    assert right == "+50.0 (+50.0 to +50.0)"


def test_recall_and_precision_are_shares_of_all_objects_and_boxes():
    """Of two pictures, one of them drawn twice."""

    def record(objects, found, boxes, right):
        return {"objects": objects, "found": found, "boxes": boxes, "right": right}

    finding = {
        "semfov": [record(4, [1, 2, 3], 5, 3), record(2, [0, 1], 1, 1)],
        "nothing": [record(4, [0], 0, 0), record(2, [0], 0, 0)],
    }
    for drawn, expected in (([0, 1], [1 / 6, 4 / 6, 4 / 6]), ([1, 0, 1], [1 / 8, 5 / 8, 5 / 7])):
        got = recall_and_precision(finding, [1, 3], torch.tensor(drawn))
        assert got[0].tolist() == pytest.approx(expected)
        assert got[1, :2].tolist() == [0, 0]
        assert got[1, 2].isnan()
    # Samples that lie apart by a standard deviation of these figures.
    samples = torch.stack([got[1:] - got[:1] / 2**0.5, got[1:] + got[:1] / 2**0.5])
    figures = Bootstrap(got[1:], samples)
    assert _recall_cells(figures, 0, "+") == (["+0.000 ± 0.125", "+0.000 ± 0.625"], "-")


def test_orders_look_at_every_slice_once(zooming):
    run = ZoomRun(zooming)
    source = run.looks_at(0)
    cut = run.slices(0, source.lattice)
    for order in (in_order(cut), shuffled(cut, [1]), ranked(cut)):
        windows = [step.look.window for step in look_by_look(source, order, None)]
        assert windows[0].level == 0
        assert set(windows[1:]) == set(cut)
        assert len(windows) == len(cut) + 1
    tree = [step.look.window for step in look_by_look(source, quad_tree(source.lattice, 1, most=True), None)]
    assert len(tree) == len(set(tree))


def test_slices_match_those_of_sahi():
    lattice = Lattice.over((3840, 2160), (416, 416))
    windows = slices(lattice, 640, 512)
    assert len(windows) == 32
    corners = [window.within for window in windows]
    assert corners[0] == (0, 0, 640, 640)
    assert corners[-1] == (3200, 1520, 3840, 2160)
