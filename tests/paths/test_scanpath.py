"""Scanpaths as text, tables and files, and the views that they keep."""

import math
import sys
from dataclasses import replace

import pytest
import torch

from semfov import ActivePerception, Detections, Eye, Foveation, Grid, Scanpath, observers, policies
from semfov.decision import CloseUp, Decision
from semfov.detection import Candidates, Detector, Placement
from semfov.errors import DataError
from semfov.io.storage import read, write_file
from semfov.paths.stimulus import LONGEST, Stimulus, reduced_copy
from tests import small
from tests.paths.test_records import same
from tests.refusals import refused


class Bright(Detector):
    """Detects one object at the brightest place of the image, of a class that depends on its colour."""

    def __init__(self, size=(96, 96), stride=None) -> None:
        super().__init__("bright", ("red", "green"), size)
        self.stride = stride

    def propose(self, canvas):
        y, x = divmod(int(canvas[0].sum(0).argmax()), canvas.shape[-1])
        box = canvas.new_tensor([[[x - 8.0, y - 8.0, x + 8.0, y + 8.0]]])
        return Candidates(box, canvas[:, :2, y, x][:, None] * 0.9)


@pytest.fixture
def image():
    torch.manual_seed(0)
    picture = torch.rand(3, 90, 130) * 0.6
    picture[0, 60:75, 90:110] = 1
    return picture


@pytest.fixture
def agent():
    eye = Eye(Foveation(20.0), Bright(), reference=130.0)
    observer = observers.Semantic(3)
    return ActivePerception(
        eye, (observer, policies.Policy("non-predictive")), (observer, policies.Policy("random")), grid=(5, 4)
    ).eval()


def test_a_record_counts_detections_from_the_score_that_the_detector_names(agent, image):
    agent.eye.detector.score_threshold = 0.95
    assert len(agent.explore(image, start=3, shifts=2).objects) == 0
    agent.eye.detector.score_threshold = 0.2
    assert len(agent.explore(image, start=3, shifts=2).objects) > 0


def test_a_find_without_a_box_is_at_the_centre_of_its_cell(agent, image):
    """Cell 6 of 5 × 4 is the second of the second row; pixels have their centres at integers."""
    search = agent.search(image, "red", how="fovea", start=3, shifts=2)
    in_cell = replace(search, decision=Decision("found", 0.9, 6), closer=())
    assert in_cell.found_at == pytest.approx((1.5 * 130 / 5 - 0.5, 1.5 * 90 / 4 - 0.5))
    values = in_cell.to_dict()
    assert (values["x"], values["y"], values["x1"]) == (*map(pytest.approx, in_cell.found_at), None)
    for decision in (Decision("absent", 0.1, 6), Decision("found", 0.9)):
        assert replace(in_cell, decision=decision).found_at is None


@pytest.fixture(params=["search", "exploration"])
def scanpath(request, agent, image):
    with torch.inference_mode():
        if request.param == "search":
            return agent.search(image, "red", start=0, shifts=4, confirm=1.0)
        return agent.explore(image, start=3, shifts=11)


def test_scanpaths_of_agents_keep_the_views(agent, image, scanpath):
    """The views equal the input of the detector, up to rounding to bytes."""
    view = agent.eye.open(image[None])
    with torch.inference_mode():
        shown = agent.eye.foveated(view, scanpath.fixations)
    left, top = view.placement.offset
    views = scanpath.views()
    assert len(views) == len(scanpath)
    for got, canvas in zip(views, shown, strict=True):
        height, width = got.shape[1:]
        assert (width, height) == tuple(round(n * view.placement.scale[0]) for n in (130, 90))
        torch.testing.assert_close(got, canvas[:, top : top + height, left : left + width], rtol=0, atol=1.01 / 255)
    torch.testing.assert_close(scanpath.image, image, rtol=0, atol=0.51 / 255)
    assert scanpath.photograph.dtype == torch.uint8
    assert scanpath.stimulus.settings == agent.eye.settings()


@pytest.mark.parametrize("growth", [1.0, 2.0])
def test_views_of_a_stretched_canvas_equal_those_of_the_eye(growth):
    class Wide(Bright):
        def fit(self, images):
            canvas = torch.nn.functional.interpolate(images, (64, 128), mode="bilinear")
            return canvas, Placement((images.shape[-1], images.shape[-2]), (128 / 100, 64 / 100), (0, 0))

    eye = Eye(Foveation(30.0, growth=growth), Wide(), reference=200.0)
    image, points = torch.rand(3, 100, 100), torch.tensor([[10.0, 80.0], [99.0, 0.0]])
    kept = Stimulus.of(eye, image)
    torch.testing.assert_close(
        torch.stack(kept.views(points)), eye.foveated(eye.open(image[None]), points), rtol=0, atol=1.01 / 255
    )


def test_large_photographs_are_reduced():
    image = torch.rand(3, 700, 2 * LONGEST)
    kept = Stimulus.of(Eye(Foveation(20.0), Bright()), image)
    assert reduced_copy(image).shape == (3, 350, LONGEST)
    assert kept.placement.size == (2 * LONGEST, 700)


def test_a_scanpath_without_a_photograph_has_no_views_or_pictures(scanpath):
    bare = replace(scanpath, stimulus=None, photograph=None)
    assert bare.image is None
    for call in (bare.views, bare.plot, bare.animate):
        refused(r"kept|stimulus", call)


def test_rows_have_cells_times_and_the_belief(scanpath):
    rows = scanpath.rows()
    for number, row in enumerate(rows):
        cell = int(scanpath.cells[number])
        assert (row["cell"], row["row"] * 5 + row["column"]) == (cell, cell)
        passed = sum(sum(each.values()) for each in scanpath.seconds[: number + 1])
        assert row["seconds"] == pytest.approx(passed, abs=5e-4)  # a table has milliseconds
        if scanpath.target is None:
            assert {row[name] for name in ("probability", "highest", "highest_cell", "presence")} == {None}
        else:
            belief = scanpath.posterior[number]
            assert row["probability"] == pytest.approx(float(belief[cell]), rel=5e-4)  # and four digits
            assert float(belief[row["highest_cell"]]) == float(belief.max())
            assert row["highest"] == pytest.approx(float(belief.max()), rel=5e-4)
            assert row["presence"] == pytest.approx(float(scanpath.presence[number]), rel=5e-4)


@pytest.mark.parametrize("target", [None, 1])
def test_rows_without_detections_and_times(scanpath, target):
    nothing = small.scanpath(scanpath.grid, scanpath.cells, scanpath.classes, target=target)
    for row in nothing.rows():
        assert (row["detections"], row["seen"], row["score"], row["seconds"]) == (0, None, None, None)
        assert (row["probability"], row["highest"], row["presence"]) == (None, None, None)


def test_to_frame_without_pandas_names_the_remedy(scanpath, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    refused("pip install pandas", scanpath.to_frame)


def variants(scanpath):
    none = Detections.empty(1, 2)
    values = scanpath.values.clone()
    values[0, :3] = torch.tensor([-math.inf, math.inf, math.nan])
    double = {name: getattr(scanpath, name).double() for name in ("probabilities", "values")}
    count = len(scanpath)
    padded = [Detections.stack([each, none])[:1] for each in scanpath.detections]
    untimed = small.with_looks(scanpath, seconds=[None] * count, stages=[{}] * count)
    return {
        "bare": replace(untimed, stimulus=None, photograph=None, decision=None, ending=None),
        "nothing seen": small.with_looks(scanpath, detections=[none] * count),
        "not finite": replace(scanpath, values=values),
        "padded": small.with_looks(scanpath, detections=padded),
        "double": replace(scanpath, **double),
        "found": replace(scanpath, found=True, target=2, decision=Decision("found", 0.1 + 0.2, 7, torch.rand(4))),
        "closer": replace(
            scanpath,
            closer=(CloseUp(0, 2, 3, torch.rand(4), 0.2, 0.4), CloseUp(1, 1, 0, torch.rand(4), 0.7, 0.8)),
            decision=Decision("found", 0.8, 0, torch.rand(4), 0.7),
        ),
        "absent": replace(scanpath, target=1, decision=Decision("absent", 1e-300), ending="decision"),
        "other grid": replace(scanpath, grid=Grid(5, 4, (130.5, 90.25))),
    }  # fmt: skip


VARIANTS = ["bare", "nothing seen", "not finite", "padded", "double", "found", "closer", "absent", "other grid"]


@pytest.mark.parametrize("name", VARIANTS)
def test_files_keep_scanpaths_of_every_kind(name, scanpath, tmp_path):
    changed = variants(scanpath)[name]
    changed.save(tmp_path / "a.safetensors")
    loaded = Scanpath.load(tmp_path / "a.safetensors")
    for field in Scanpath.__dataclass_fields__:
        assert same(getattr(changed, field), getattr(loaded, field)), field


def spoil(tensors, record):
    """Contents of inconsistent files, with the name that the error must contain."""

    def changed(name, value):
        return {**tensors, name: value}, record

    def told(**values):
        return tensors, {**record, **values}

    found = {"outcome": "found", "probability": 0.5, "cell": None, "place": None, "confirm": None}
    yield "cells", changed("cells", tensors["cells"] + 20)
    yield "cells", changed("cells", tensors["cells"].float())
    yield "fixations", changed("fixations", tensors["fixations"][:-1])
    yield "fixations", changed("fixations", tensors["fixations"] * math.nan)
    yield "probabilities", changed("probabilities", tensors["probabilities"] - 1)
    yield "probabilities", changed("probabilities", tensors["probabilities"][..., :2])
    yield "values", changed("values", tensors["values"][:, :-1])
    yield "scores", changed("scores", tensors["scores"][:, :-1])
    yield "canvas", changed("canvas", tensors["canvas"].float())
    yield "photograph", changed("photograph", torch.zeros(3, 4, LONGEST + 1, dtype=torch.uint8))
    yield "photograph", ({k: v for k, v in tensors.items() if k != "canvas"}, record)
    yield "placement", told(placement={**record["placement"], "offset": [0, 60]})
    yield "placement", told(placement={**record["placement"], "scale": [1e9, 1.0]})
    yield "tensors", changed("more", torch.zeros(1))
    yield "grid", told(grid=[5, 0])
    yield "values", told(grid=[5, 5])
    yield "target", told(target=0)
    yield "found", told(found=1)
    yield "lengths", told(lengths=[n + 1 for n in record["lengths"]])
    yield "seconds", told(seconds=record["seconds"][1:])
    yield "decision", told(decision={**found, "outcome": "perhaps"})
    yield "decision.cell", told(decision={**found, "cell": 20})
    look = {"fixation": 0, "index": None, "target": 1, "cell": 1, "place": 0.5, "presence": 0.5}
    yield "closer_boxes", told(closer=[look])
    yield "closer", (changed("closer_boxes", torch.zeros(1, 4))[0], {**record, "closer": [{**look, "cell": 20}]})
    yield "closer", (changed("closer_boxes", torch.zeros(1, 4))[0], {**record, "closer": [{**look, "target": 3}]})
    yield "closer[0].place", told(closer=[{**look, "place": 1.5}])
    yield "settings.sensor", told(settings={**record["settings"], "sensor": {}})
    yield (
        "settings.sensor.levels",
        told(settings={**record["settings"], "sensor": {**record["settings"]["sensor"], "levels": 1000}}),
    )
    for name in record:
        yield name.split(".")[0], (tensors, {key: value for key, value in record.items() if key != name})


OPTIONAL = "decision", "ending", "target", "prior", "assumed", "source", "shown", "detector", "placement", "settings"


def test_inconsistent_files_are_refused_with_the_name_of_the_field(scanpath, tmp_path):
    scanpath.save(tmp_path / "a.safetensors")
    tensors, record = read(tmp_path / "a.safetensors", "scanpath")
    record.pop("kind")
    for number, (named, (parts, told)) in enumerate(spoil(tensors, record)):
        # Fields that may be null may also be missing.
        if named in OPTIONAL and len(told) < len(record):
            continue
        path = tmp_path / f"{number}.safetensors"
        write_file(path, parts, {"kind": "scanpath", **told})
        with pytest.raises(DataError, match="expected a complete scanpath") as caught:
            Scanpath.load(path)
        assert named in str(caught.value), (named, caught.value)
