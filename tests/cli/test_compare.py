"""The command `semfov compare`: semfov beside slices, with annotations and with what all slices list as the truth."""

import csv
import json

import pytest
from PIL import Image

from semfov.cli import compare as command
from semfov.cli.rivals import Point
from semfov.zoom.lattice import Lattice

SQUARES = {"a": [(1000, 700), (100, 300)], "b": [(600, 420)]}


@pytest.fixture
def compare(run, agent, evidence, monkeypatch, tmp_path):
    """Runs the command on two pictures with red squares; returns its code, what it printed, and its points by way."""
    monkeypatch.setattr(command, "make_agent", lambda options: agent)
    monkeypatch.setattr(command, "detector_classes", lambda options: None)
    agent.windows = evidence
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    ground = Image.linear_gradient("L").point(lambda value: 90 + value // 8)
    for name, places in SQUARES.items():
        picture = ground.resize((1280, 960)).convert("RGB")
        for x, y in places:
            picture.paste((230, 20, 20), (x, y, x + 40, y + 40))
        picture.save(pictures / f"{name}.png")

    def run_compare(*options, out="out"):
        code, printed = run("compare", pictures, "--target", "red", "--out", tmp_path / out, *options)
        points: dict[str, list[dict[str, str]]] = {}
        table = tmp_path / out / "compare.csv"
        if table.exists():
            for row in csv.DictReader(table.read_text("utf-8").splitlines()):
                points.setdefault(row["way"], []).append(row)
        return code, printed, points

    return run_compare


@pytest.fixture
def truth(tmp_path):
    """The squares in COCO's format."""
    images = [{"id": name, "file_name": f"{name}.png", "width": 1280, "height": 960} for name in SQUARES]
    boxes = [
        {"image_id": name, "category_id": 7, "bbox": [x, y, 40, 40]}
        for name, places in SQUARES.items()
        for x, y in places
    ]
    path = tmp_path / "truth.json"
    path.write_text(json.dumps({"images": images, "annotations": boxes, "categories": [{"id": 7, "name": "red"}]}))
    return path


def slice_count(width, height, side, overlap):
    """Number of slices by the loop of SAHI, whose last slices of a row and a column are moved inside the picture."""
    step = side - int(overlap * side)
    count, bottom, top = 0, 0, 0
    while bottom < height:
        left, right = 0, 0
        bottom = top + side
        while right < width:
            right = left + side
            count += 1
            left = right - int(overlap * side)
        top = bottom - int(overlap * side)
    assert step > 0
    return count


def test_all_slices_find_the_annotated_squares_and_ranked_ones_the_same_in_the_end(compare, truth):
    most = 1 + slice_count(1280, 960, 480, 0.25)
    code, printed, points = compare(
        "--annotations", truth, "--with", "sahi,ranked", "--slice", 480, "--overlap", 0.25, "--passes", most
    )
    assert code == 0
    (slices,) = points["all slices"]
    assert float(slices["passes"]) == most
    assert float(slices["ap50"]) > 0.9
    assert slices["right"] == slices["reference"] == "3"
    last = points["best slices"][-1]
    assert [last[name] for name in ("passes", "ap50", "listed")] == [
        slices[name] for name in ("passes", "ap50", "listed")
    ]
    passes = [float(point["passes"]) for point in points["semfov"]]
    assert passes == sorted(set(passes))
    assert float(points["semfov"][-1]["ap50"]) >= float(points["semfov"][0]["ap50"])
    for point in (slices, *points["best slices"], *points["semfov"]):
        assert [len(point[name].partition(".")[2]) <= most for name, most in (("seconds", 3), ("ap50", 4))] == [
            True
        ] * 2
    assert f"all slices have an AP50 of {float(slices['ap50']):.3f}" in printed.out


def test_without_annotations_all_slices_are_the_truth(compare, tmp_path):
    code, printed, points = compare("--passes", 3, "--slice", 480)
    assert code == 0
    (slices,) = points["all slices"]
    assert int(slices["listed"]) >= 3
    assert slices["listed"] == slices["right"] == slices["reference"]
    assert float(slices["ap50"]) == 1.0
    assert "give --annotations FILE" in printed.out
    page = (tmp_path / "out" / "compare.html").read_text("utf-8")
    assert f"of the {slices['reference']} objects that all slices list" in page
    head = "2 pictures, red; all slices are taken as the truth"
    assert printed.out.startswith(f"{head}\n")
    assert page.index(head) < page.index("<figure>")
    assert (tmp_path / "out" / "compare.png").stat().st_size > 0


def test_what_cannot_be_compared_is_refused(compare, truth, tmp_path):
    for options, words in (
        (("--with", "ranked"), "or --annotations FILE, got ranked alone"),
        (("--with", "none"), "with: expected sahi, ranked, or both, got none"),
        (("--passes", 0), "passes: expected a whole number from 1"),
    ):
        code, printed, _ = compare(*options)
        assert code != 0
        assert words in printed.err
    # A picture that the annotations lack is left out, and said.
    (tmp_path / "pictures" / "c.png").write_bytes((tmp_path / "pictures" / "a.png").read_bytes())
    code, printed, points = compare("--annotations", truth, "--passes", 1, "--slice", 640)
    assert code == 1
    assert "skipped" in printed.err
    assert points["all slices"][0]["reference"] == "3"


def test_the_name_of_the_folder_may_have_a_point(compare, tmp_path):
    code, _, points = compare("--passes", 1, "--slice", 640, out="run-1.5")
    assert (code, sorted(points)) == (0, ["all slices", "semfov"])
    code, printed, _ = compare("--passes", 1, out="page.HTML")
    assert code != 0
    assert "out: expected a folder, for compare.html, compare.csv and compare.png" in printed.err


def test_where_every_picture_is_skipped_nothing_is_written(compare, truth, tmp_path):
    for name in SQUARES:
        (tmp_path / "pictures" / f"{name}.png").rename(tmp_path / "pictures" / f"other-{name}.png")
    code, printed, points = compare("--annotations", truth, "--passes", 1)
    assert code == 1
    assert printed.err.count("skipped") == 2
    assert "no picture could be looked at" in printed.err
    assert (printed.out, points) == ("", {})
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.parametrize(
    ("precisions", "told"),
    [
        ((0.6, 0.4, 0.5, 0.7), "from 3 passes and 3.00 s on"),
        ((0.5, 0.6), "from 1 pass and 1.00 s on"),
        ((0.6, 0.4), None),
        ((None, 0.5), "from 2 passes and 2.00 s on"),
    ],
)
def test_it_is_level_from_where_no_later_point_falls_below(precisions, told):
    ours = [
        Point("semfov", float(number), float(number), precision, 3, 3, 3)
        for number, precision in enumerate(precisions, start=1)
    ]
    sentences = command.conclusion([*ours, Point("all slices", 9.0, 9.0, 0.5, 3, 3, 3)], is_truth=True)
    level = [sentence for sentence in sentences if "level" in sentence]
    assert level == ([] if told is None else [f"It is level with them {told}."])


def test_a_slice_as_large_as_the_picture_repeats_no_look(agent):
    from semfov.cli.rivals import _slices_of

    lattice = Lattice.over((1280, 960), agent.eye.detector.input_size)
    assert _slices_of(lattice, 1280, 0.2) == []
    assert len(_slices_of(lattice, 640, 0.2)) == slice_count(1280, 960, 640, 0.2)
