"""Search, find and explore as a user runs them, with a detector of red squares: texts, results, figures and pages."""

import csv
import io
import json
import os
import re
import shutil
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
import torch
from PIL import Image
from pycocotools.coco import COCO

import semfov.cli.main
from semfov import read_image
from semfov.cli.formats import Csv
from semfov.cli.options import FindOptions, SearchOptions
from semfov.cli.search import with_target
from semfov.cli.sources import picture_sources
from semfov.cli.truth import Truth
from semfov.data.picture_files import picture_files
from semfov.observation.thresholds import Thresholds
from tests.colours import write_network
from tests.refusals import unusable


def episodes_of(page):
    text = page.read_text(encoding="utf-8")
    return json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])["episodes"]


def written_files(printed):
    return [line.strip() for line in printed.out.partition("written:\n")[2].splitlines() if line.startswith("  ")]


def test_a_search_says_where_and_writes_what_is_asked_for(run, photo, tmp_path):
    code, printed = run("search", photo, "--target", "red", "--start", "7,5", "--looks", "--out", tmp_path / "out",
                        "--report", tmp_path / "page.html")  # fmt: skip
    assert code == 0
    found = re.search(
        r"my photo\.png, 160 × 120 px: found red at \((\d+), (\d+)\)(, box (\S+))?, belief [01]\.\d\d\n"
        r"  \w.*\. \d+ looks in \d+\.\d s\.", printed.out,
    )  # fmt: skip
    assert found
    assert 8 <= int(found[1]) <= 28
    assert 8 <= int(found[2]) <= 28
    assert "  1     (150, 110)" in printed.out  # the middle of the cell in column 7 and row 5 of 8 × 6
    names = {"results.json", "scanpath.png", "views.png", "belief.png", "animation.gif"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == names
    listed = written_files(printed)
    assert {str(tmp_path / "out" / name) for name in names} | {str(tmp_path / "page.html")} == set(listed)
    (episode,) = episodes_of(tmp_path / "page.html")
    assert episode["name"] == "my photo.png"
    (result,) = json.loads((tmp_path / "out/results.json").read_text())["pictures"]
    assert (result["outcome"], result["picture"]) == ("found", str(photo))
    assert (round(result["x"]), round(result["y"])) == (int(found[1]), int(found[2]))


def test_a_file_of_settings_names_the_picture_unless_one_follows_it(run, photo, tmp_path):
    settings = tmp_path / "settings.yaml"
    settings.write_text(json.dumps({"pictures": [str(photo)], "target": "red", "start": "47"}))
    code, printed = run("search", "--config", settings)
    assert code == 0
    assert f"{photo.name}, 160 × 120 px: found red" in printed.out
    other = photo.with_name("other.png")
    Image.open(photo).crop((0, 0, 80, 60)).save(other)
    _, printed = run("search", "--config", settings, other)
    assert "other.png, 80 × 60 px" in printed.out
    assert photo.name not in printed.out


def test_nothing_is_written_unless_it_is_asked_for(run, photo, tmp_path):
    before = set(tmp_path.rglob("*"))
    code, printed = run("search", photo, "--target", "red", "--start", 47)
    assert code == 0
    assert "written:" not in printed.out
    assert set(tmp_path.rglob("*")) == before
    code, printed = run("search", photo, "--target", "red", "--start", 47, "--out", tmp_path / "out", "--draw", "none")
    assert written_files(printed) == [str(tmp_path / "out/results.json")]


def test_a_name_of_a_picture_gets_the_figure_of_one(run, photo, folder, tmp_path):
    code, printed = run("search", photo, "--target", "red", "--start", 47, "--out", tmp_path / "found.png")
    assert code == 0
    assert written_files(printed) == [str(tmp_path / "found.png")]
    with Image.open(tmp_path / "found.png", formats=["PNG"]) as figure:
        assert figure.width > 400
    run("find", photo, "--how", "fovea", "--shifts", 1, "--out", tmp_path / "found.svg")
    assert "<svg" in (tmp_path / "found.svg").read_text("utf-8")
    code, printed = run("search", folder, "--target", "red", "--out", tmp_path / "all.png")
    assert code != 0
    assert "out: expected a folder for the figures of 3 pictures, got" in printed.err


@pytest.mark.parametrize("words", [("find",), ("gaze",), ("explore", "--how", "fovea", "--shifts", 1)])
def test_no_figure_takes_the_place_of_the_picture_that_is_looked_at(run, tmp_path, photo, words, monkeypatch):
    picture = photo.rename(tmp_path / "scanpath.png")
    before = picture.read_bytes()
    monkeypatch.chdir(tmp_path)
    out = "." if words[0] == "explore" else f"./{picture.name}"
    code, printed = run(*words, picture, "--out", out)
    assert code == 1
    assert "out: expected a file other than the one that is looked at" in printed.err
    assert picture.read_bytes() == before


@pytest.mark.parametrize("task", ["search", "explore"])
def test_only_the_named_figures_are_drawn(run, photo, tmp_path, task):
    more, draw = ("--shifts", 1), "belief"
    if task == "search":
        more, draw = ("--target", "red", "--start", 47), "belief,belief_bars"
    code, _ = run(task, photo, *more, "--out", tmp_path / "found.json", "--draw", draw)
    assert code == 0
    wanted = {"belief.png", "belief_bars.png"} if task == "search" else {"map.png"}
    assert {file.name for file in (tmp_path / "found").iterdir()} == wanted


@pytest.mark.parametrize(
    ("words", "refused"),
    [
        (
            ("find", "--draw", "belief"),
            r"scanpath or animation for \S+a.png, which is looked at by 'windows', got belief",
        ),
        (("explore", "--draw", "scanpath,belief_bars"), "views or belief or animation for .* 'fovea', got belief_bars"),
        (("search", "--target", "red", "--how", "head", "--draw", "views,scanpath"), "by 'head', got views"),
    ],
    ids=lambda words: words[0] if isinstance(words, tuple) else "",
)
def test_figures_that_the_looks_do_not_have_are_refused_before_the_first_look(run, folder, tmp_path, words, refused):
    task, *more = words
    code, printed = run(task, folder, *more, "--out", tmp_path / "out")
    assert code == 1
    assert re.search(refused, printed.err)
    assert (printed.out, (tmp_path / "out").exists()) == ("", False)


def test_a_description_is_matched_to_classes_by_word_vectors(run, photo, tmp_path):
    vectors = tmp_path / "vectors.txt"
    vectors.write_text("red 1 0.8\nwine 0.8 1\nglass 1 1\ncrimson 1 0.9\n")
    described = ["search", photo, "--target", "something crimson", "--start", 47]
    code, printed = run(*described, "--embeddings", vectors)
    assert code == 0
    assert re.search(r"may mean: (red|wine glass) 1\.00, (red|wine glass) 0\.\d\d", printed.out)
    assert "found red" in printed.out
    code, printed = run(*described)
    assert code == 1
    assert "unknown class" in printed.err
    assert "--embeddings" in printed.err


def test_all_objects_are_listed_and_written_as_tables(run, photo, large, tmp_path, agent, evidence):
    """The box of the square is the same in every format, and a table has a line for each object."""
    agent.windows = evidence
    for kind in ("json", "csv", "geojson", "coco.json"):
        code, _ = run("find", photo, large, "--target", "red", "--passes", 4, "--out", tmp_path / f"boxes.{kind}")
        assert code == 0
    first, second = json.loads((tmp_path / "boxes.json").read_text())["pictures"]
    boxes = [[row[edge] for edge in ("x1", "y1", "x2", "y2")] for row in (*first["objects"], *second["objects"])]
    assert boxes[0] == pytest.approx([8, 8, 28, 28], abs=1)
    assert boxes[1] == pytest.approx([1000, 700, 1040, 740], abs=8)
    assert (second["width"], second["height"]) == (1280, 960)
    assert list(second["expected"]) == ["red"]
    with (tmp_path / "boxes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["picture"], row["class"]) for row in rows] == [(str(photo), "red"), (str(large), "red")]
    assert [[float(row[edge]) for edge in ("x1", "y1", "x2", "y2")] for row in rows] == boxes
    coco = json.loads((tmp_path / "boxes.coco.json").read_text())
    names = {each["id"]: each["name"] for each in coco["categories"]}
    for each, (x1, y1, x2, y2), image in zip(coco["annotations"], boxes, coco["images"], strict=True):
        assert each["bbox"] == pytest.approx([x1, y1, x2 - x1, y2 - y1])
        assert each["area"] == round(each["bbox"][2] * each["bbox"][3], 2)  # no more digits than its sides
        assert (names[each["category_id"]], each["image_id"]) == ("red", image["id"])
    places = json.loads((tmp_path / "boxes.geojson").read_text())["features"]
    corners = [each["geometry"]["coordinates"][0] for each in places]
    assert [[min(x), min(y), max(x), max(y)] for x, y in (zip(*ring, strict=True) for ring in corners)] == boxes
    assert [each["properties"]["picture"] for each in places] == [str(photo), str(large)]


def test_results_have_the_ids_of_annotations_and_are_judged_by_pycocotools(run, photo, tmp_path):
    """A right box of the one object gives AP 1; a category that was not sought is not judged."""
    squares = [{"id": 1, "image_id": 77, "category_id": 5, "bbox": [8, 8, 20, 20], "area": 400, "iscrowd": 0}]
    squares += [{**squares[0], "id": 2, "category_id": 9, "bbox": [80, 60, 9, 9]}]
    truth = {
        "images": [{"id": 77, "file_name": photo.name, "width": 160, "height": 120}, {"id": 78, "file_name": "b.png",
                   "width": 8, "height": 8}],
        "categories": [{"id": 9, "name": "gull"}, {"id": 5, "name": "Red"}],
        "annotations": squares,
    }  # fmt: skip
    file = tmp_path / "gt.json"
    file.write_text(json.dumps(truth))
    out = ("--out", tmp_path / "boxes.coco.json", "--annotations", file)
    code, printed = run("find", photo, *out)
    assert code == 0
    assert re.search(r"AP (1|0\.[89])\S*, AP50 1\.000 against .*gt\.json \(1 pictures, 1 boxes\)", printed.out)
    (found,) = json.loads((tmp_path / "boxes.coco.json").read_text())
    assert (found["image_id"], found["category_id"]) == (77, 5)
    coco = COCO(str(file))
    assert coco.loadRes(str(tmp_path / "boxes.coco.json")).getAnnIds() == [1]
    code, printed = run("find", photo, "--out", tmp_path / "boxes.json", "--annotations", file)
    assert (code, "annotations: expected --out FILE.coco.json beside it" in printed.err) == (1, True)
    file.write_text(json.dumps({**truth, "images": [{**truth["images"][0], "width": 120, "height": 160}]}))
    code, printed = run("find", photo, *out)
    assert (code, "to have 120 × 160 px, got 160 × 120" in printed.err) == (1, True)


def test_ids_may_be_texts_and_what_the_file_leaves_out_is_not_needed(run, photo, tmp_path):
    """Results have the first id of a name that stands twice; without objects of the classes there is no AP."""
    truth = {
        "images": [{"id": "p-0", "file_name": f"upload\\1\\{photo.name}"}],
        "categories": [{"id": "a", "name": "red"}, {"id": "b", "name": "Red"}, {"id": "c", "name": "wine glass"}],
        "annotations": [{"id": "x", "image_id": "p-0", "category_id": "b", "bbox": [8, 8, 20, 20], "area": None}],
    }
    file, out = tmp_path / "gt.json", tmp_path / "boxes.coco.json"
    file.write_text(json.dumps(truth))
    code, printed = run("find", photo, "--out", out, "--annotations", file)
    assert (code, "AP50 1.000 against" in printed.out) == (0, True)
    (found,) = json.loads(out.read_text())
    assert (found["image_id"], found["category_id"]) == ("p-0", "a")
    code, printed = run("find", photo, "--target", "wine glass", "--out", out, "--annotations", file)
    assert code == 0
    assert re.search(
        r"no AP: \S*gt\.json has no boxes of these classes in these pictures \(1 pictures, 0 boxes", printed.out
    )


def test_annotations_that_cannot_judge_are_refused_before_the_first_look(run, photo, tmp_path, agent, monkeypatch):
    monkeypatch.setattr(type(agent), "find_all", lambda *_, **__: pytest.fail("a picture was looked at"))
    truth = {
        "images": [{"id": 1, "file_name": photo.name, "width": 160, "height": 120}],
        "categories": [{"id": 1, "name": "gull"}],
        "annotations": [],
    }
    file = tmp_path / "gt.json"
    with_annotations = ("find", photo, "--out", tmp_path / "boxes.coco.json", "--annotations", file)
    for change, message in (
        ({}, "annotations: expected some of the classes red, wine glass as categories, got gull"),
        ({"annotations": [{"image_id": 1, "category_id": 1, "bbox": [5, 5, -3, 4]}]}, "a size of at least 0"),
        ({"categories": [{"id": 1, "name": "red"}], "images": [{**truth["images"][0], "width": 99}]}, "99 × 120 px"),
    ):
        file.write_text(json.dumps(truth | change))
        code, printed = run(*with_annotations)
        assert (code, message in printed.err) == (1, True)


def test_boxes_without_area_are_told(make_truth, tmp_path):
    make_truth("x.jpg")
    path = tmp_path / "truth.json"
    data = json.loads(path.read_text())
    data["annotations"] = [{"image_id": 1, "category_id": 1, "bbox": [2, 2, 0, 4]}]
    path.write_text(json.dumps(data))
    with pytest.warns(UserWarning, match=r"truth\.json: 1 boxes have no area, and are not judged"):
        Truth(path)


def test_pictures_are_found_in_annotations_by_the_ends_of_their_paths(make_truth):
    truth = make_truth("a/x.jpg", "b\\x.jpg", "y.jpg")
    assert truth.image_id("/photos/b/x.jpg") == 2
    assert truth.image_id("../elsewhere/y.jpg") == 3
    for name in ("c/x.jpg", "x.jpg", "z.jpg"):
        unusable("expected one image with the file_name of", truth.image_id, name)


def test_pictures_are_found_as_other_systems_and_addresses_write_their_names(make_truth):
    composed, apart = "K\u00fcche.jpg", "Ku\u0308che.jpg"  # as Linux and Windows, and as macOS names the file
    truth = make_truth(f"a/{composed}", "my%20photo.JPG", "b/x.jpg", "B/X.jpg", "100%.png")
    assert [truth.image_id(name) for name in (composed, apart)] == [1, 1]
    assert truth.image_id("/photos/my photo.jpg") == 2
    assert [truth.image_id(name) for name in ("b/x.jpg", "B/X.jpg", "c/x.jpg")] == [3, 4, 3]
    assert truth.image_id("100%.png") == 5
    unusable("expected one image .* of z.jpg, got 0 of 5, which are named as 'a/K", truth.image_id, "z.jpg")


def test_pictures_have_the_names_that_programs_gave_to_what_was_uploaded(make_truth):
    """Label Studio and Roboflow; a picture of that very name comes first, and other digits belong to names."""
    names = r"images\\0b51f2a7-kitchen.jpg", "00ff00ff-kitchen.jpg.png", "Hall_JPG.rf.4a1cdeb7f3.jpg", "a1-hall.jpg"
    truth = make_truth(*names)
    assert [truth.image_id(name) for name in ("photos/kitchen.jpg", "0b51f2a7-kitchen.jpg", "hall.jpg")] == [1, 1, 3]
    unusable("expected one image", truth.image_id, "1-hall.jpg")
    truth = make_truth("0b51f2a7-a.jpg", "00ff00ff-a.jpg", "a.jpg")
    assert [truth.image_id(name) for name in ("a.jpg", "00ff00ff-a.jpg", "11111111-a.jpg")] == [3, 2, 3]
    truth = make_truth("0b51f2a7-a.jpg", "00ff00ff-a.jpg")
    unusable("got 2 of 2", truth.image_id, "a.jpg")


def test_pictures_are_found_where_addresses_and_exports_changed_their_names(make_truth):
    """Questions in addresses, separators in percent signs, blanks and brackets that an upload lost, other formats."""
    truth = make_truth(
        "/data/local-files/?d=kitchen.jpg", "/data/local-files/?d=photos%5CHall%201.jpg",
        "https://localhost/a/yard.jpg?token=b&x=1", "images/0b51f2a7-Küche_2_1.jpg", "my-room--1-_jpg.rf.4a1c.jpg",
        "street.png", "field",
    )  # fmt: skip
    names = "kitchen", "Hall 1", "yard", "K\u00fcche 2 (1)", "my room (1)", "street", "field"
    assert [truth.image_id(f"photos/{name}.jpg") for name in names] == [1, 2, 3, 4, 5, 6, 7]
    truth = make_truth("street.png", "street.jpg", "a-1.jpg", "00ff00ff-a1.jpg", "00ff00ff-b_1.jpg")
    assert [truth.image_id(name) for name in ("street.jpg", "a-1.jpg", "a1.jpg", "b 1.png")] == [2, 3, 4, 5]
    unusable("expected one image .* of street.tif, got 2 of 5", truth.image_id, "street.tif")
    marks = make_truth("c-1.jpg")  # nothing tells that it was uploaded
    unusable("got 0 of 1", marks.image_id, "c 1.jpg")


def test_dates_and_hashes_in_two_names_are_of_two_pictures(make_truth):
    dates = make_truth("20240101-cam1.jpg", "0b51f2a7-20240105-cam1.jpg", "hall_jpg.rf.4a1cdeb7f3.jpg")
    assert dates.image_id("20240105-cam1.jpg") == 2
    for name in ("20240109-cam1.jpg", "hall_jpg.rf.00000000ab.jpg"):
        unusable("got 0 of 3", dates.image_id, name)


def test_an_exact_name_wins_and_no_two_pictures_take_one_image(run, photo, make_truth, tmp_path):
    truth = make_truth("a.jpg", "dir/A.jpg", "B.jpg", "dir/b.JPG", "K%C3%BCche/c.jpg", "Bad/c.jpg")
    assert [truth.image_id(name) for name in ("/x/dir/a.jpg", "/x/A.jpg", "dir/b.jpg")] == [1, 2, 4]
    assert truth.image_id("K\u00fcche/c.jpg") == 5
    unusable("expected one image with the file_name of x/b.jpg, got 2", truth.image_id, "x/b.jpg")
    names = "IMG_1.png", "img_1.png"
    for name in names:
        shutil.copy(photo, tmp_path / name)
    make_truth(names[0])
    files = *(tmp_path / name for name in names), "--annotations", tmp_path / "truth.json"
    code, printed = run("find", *files, "--out", tmp_path / "boxes.coco.json")
    assert (code, "expected an image for each picture, got the same for" in printed.err) == (1, True)


def test_boxes_of_annotations_that_look_like_fractions_are_told(make_truth, tmp_path):
    make_truth("x.jpg")
    path = tmp_path / "truth.json"
    data = json.loads(path.read_text())
    data["annotations"] = [{"id": 1, "image_id": 1, "category_id": 1, "bbox": [0.1, 0.1, 0.3, 0.4]}]
    path.write_text(json.dumps(data))
    with pytest.warns(UserWarning, match=r"truth\.json: bbox is .* these look like fractions of the picture"):
        Truth(path)


def test_annotations_judge_nothing_where_no_picture_was_looked_at(run, make_truth, tmp_path):
    names = "x.png", "y.png"
    make_truth(*names)
    for name in names:
        (tmp_path / name).write_bytes(b"no picture")
    files = *(tmp_path / name for name in names), "--annotations", tmp_path / "truth.json"
    code, printed = run("find", *files, "--out", tmp_path / "boxes.coco.json")
    assert (code, "2 pictures: 2 skipped" in printed.out, "AP" in printed.out) == (1, True, False)


def test_a_name_with_brackets_is_that_of_its_file(tmp_path):
    for name in ("a1.png", "a[1].png"):
        (tmp_path / name).touch()
    for name, expected in (("a[1].png", ["a[1].png"]), ("a[0-9].png", ["a1.png"]), ("a*.png", ["a1.png", "a[1].png"])):
        found = picture_sources(FindOptions(pictures=(str(tmp_path / name),)))
        assert [source.file.name for source in found] == expected
    again = (str(tmp_path / "a[1].png"), str(tmp_path), f"{tmp_path}/./a1.png")
    assert [source.file.name for source in picture_sources(FindOptions(pictures=again))] == ["a[1].png", "a1.png"]


@pytest.fixture
def make_truth(tmp_path):
    def make(*names):
        images = [{"id": n, "file_name": name, "width": 8, "height": 6} for n, name in enumerate(names, 1)]
        text = json.dumps({"images": images, "annotations": [], "categories": [{"id": 1, "name": "red"}]})
        (tmp_path / "truth.json").write_text(text)
        return Truth(tmp_path / "truth.json")

    return make


def test_a_search_of_pictures_is_a_table_with_a_line_for_each(run, photo, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    photo.rename(folder / "a.png")
    Image.new("RGB", (160, 120), (100, 100, 100)).save(folder / "b.png")
    code, printed = run("search", folder, "--target", "red", "--shifts", 4, "--out", tmp_path / "found.csv")
    assert code == 0
    assert "The probabilities assume" not in printed.out  # which are scores
    with (tmp_path / "found.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert (first["outcome"], second["outcome"]) == ("found", "undecided")
    assert 8 <= float(first["x"]) <= 28
    assert second["x"] == ""


def test_a_broken_picture_is_reported_and_the_others_are_written(run, photo, tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for name in ("a.png", "c.png"):
        Image.open(photo).save(folder / name)
    (folder / "b.png").write_bytes((folder / "a.png").read_bytes()[:120])
    code, _ = run("find", folder, "--out", tmp_path / "boxes.json", "--report", tmp_path / "page.html")
    assert code == 1
    result = json.loads((tmp_path / "boxes.json").read_text())
    assert [each["picture"] for each in result["pictures"]] == [str(folder / "a.png"), str(folder / "c.png")]
    assert [each["picture"] for each in result["skipped"]] == [str(folder / "b.png")]
    assert [each["name"] for each in episodes_of(tmp_path / "page.html")] == ["a.png", "c.png"]


@pytest.mark.filterwarnings("always:.*results have these escapes")
def test_any_fault_of_one_picture_is_a_skip_with_its_reason(run, photo, tmp_path, agent, monkeypatch):
    """Names that are not UTF-8, links to nothing, and errors that nobody expected; nothing steers the terminal."""
    folder = tmp_path / "photos"
    folder.mkdir()
    names = [b"a.png", b"b\xff.png", b"c\x1b[31m.png", b"d\n.png", b"e.png"]
    for name in names:
        photo_bytes = photo.read_bytes()
        (folder / os.fsdecode(name)).write_bytes(photo_bytes)
    (folder / "f.png").symlink_to("nothing.png")
    (folder / "g\x1b[2J.png").write_bytes(b"no picture")
    (folder / "._h.png").write_bytes(b"no picture")
    find_all = agent.find_all

    def failing(picture, *arguments, **options):
        if picture.endswith("e.png"):
            raise ZeroDivisionError("an unknown\x1b fault")
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", failing)
    page = tmp_path / "page.html"
    code, printed = run("find", folder, "--out", tmp_path / "boxes.json", "--report", page, "--passes", 1)
    assert code == 1
    total = re.search(r"7 pictures: 4 looked at; (\d+ \w+ found); 3 skipped", printed.out)
    assert total
    overview = page.read_text(encoding="utf-8").partition('id="overview"')[2].partition("</section>")[0]
    assert f"<p>In all: {total[1]}; 3 pictures skipped.</p>" in overview
    for said in (
        r"e\.png: \S+e\.png: cannot be looked at \(ZeroDivisionError: an unknown",
        r"f\.png: .*no such file",
        "g",
    ):
        assert re.search(rf"skipped \S+{said}", printed.err)
    assert "\x1b" not in printed.out + printed.err
    told = "warning: pictures: 3 with control characters or bytes that are not UTF-8 in the name, such as "
    assert f"{told}{folder / 'b'}\\udcff.png; results have these escapes" in printed.err
    result = json.loads((tmp_path / "boxes.json").read_text(encoding="utf-8"))
    assert [Path(each["picture"]).name for each in result["pictures"]] == [
        "a.png", "b\\udcff.png", "c\\x1b[31m.png", "d\n.png",
    ]  # fmt: skip
    assert len(result["skipped"]) == 3
    for kind in ("geojson", "coco.json"):
        assert run("find", folder, "--out", tmp_path / f"boxes.{kind}", "--passes", 1)[0] == 1
        assert json.loads((tmp_path / f"boxes.{kind}").read_text())["skipped"] == result["skipped"]
    assert run("find", folder, "--out", tmp_path / "boxes.csv", "--passes", 1)[0] == 1
    table = pd.read_csv(tmp_path / "boxes.csv")
    assert table.error.dropna().tolist() == [each["error"] for each in result["skipped"]]
    assert run("search", folder, "--target", "red", "--out", tmp_path / "found.csv", "--passes", 1)[0] == 1
    assert pd.read_csv(tmp_path / "found.csv").error.notna().tolist() == [False] * 5 + [True] * 2


def test_folders_have_pictures_of_all_formats_that_are_read_alone(tmp_path):
    picture = Image.new("RGB", (8, 6), "red")
    kinds = {
        "jpg": "JPEG",
        "jpe": "JPEG",
        "jfif": "JPEG",
        "JP2": "JPEG2000",
        "ppm": "PPM",
        "avif": "AVIF",
        "bmp": "BMP",
    }
    for suffix, kind in kinds.items():
        picture.save(tmp_path / f"a.{suffix}", kind)
    assert len(picture_files(tmp_path)) == len(kinds)
    assert all(read_image(path).shape == (3, 6, 8) for path in picture_files(tmp_path))


def test_the_names_of_a_shell_are_those_of_a_folder_and_a_class_may_stand_among_them(folder, tmp_path):
    for name in ("film.mp4", "notes.txt"):
        (folder / name).touch()
    said = r"2 files left out, of another kind than photographs \(`semfov live` takes videos\): \S+film.mp4"
    shown = []
    for names in ([folder], sorted(folder.iterdir()), [folder / "*"]):
        with pytest.warns(UserWarning, match=said):
            sources = picture_sources(FindOptions(pictures=tuple(map(str, names))))
        shown.append([source.file for source in sources])
    assert shown[0] == shown[1] == shown[2] != []
    options = SearchOptions(pictures=("a.jpg", "Cups", "b.jpg"))
    assert with_target(options) == replace(options, pictures=("a.jpg", "b.jpg"), target="Cups")
    options = FindOptions(pictures=("example:beach", "boat"))
    assert with_target(options) == replace(options, pictures=("example:beach",), target="boat")
    for others in (("a.jpg", "cupp"), ("a.jpg", "cup", "fork"), ("cup",)):
        options = FindOptions(pictures=others)
        assert with_target(options) is options
    unnamed = FindOptions(pictures=("a.jpg", "cupp"), detector=str(write_network(tmp_path / "mine.onnx")))
    assert with_target(unnamed).target == "cupp"  # checked against its classes once these are known


def test_a_survey_tells_nothing_from_what_was_not_looked_at(run, folder, tmp_path):
    """A picture without objects has a row for each class, one that cannot be read a row that is of no class."""
    Image.new("RGB", (160, 120), (100, 100, 100)).save(folder / "d.png")
    (folder / "e.png").write_bytes(b"no picture")
    code, _ = run("find", folder, "--target", "red,wine glass", "--out", tmp_path / "found.csv")
    assert code == 1
    table = pd.read_csv(tmp_path / "found.csv")
    assert set(table.picture) == {str(folder / f"{name}.png") for name in "abcde"}
    (wrong,) = table[table.error.notna()].to_dict("records")
    assert Path(wrong["picture"]).name == "e.png"
    assert "e.png: not an image" in wrong["error"]
    assert pd.isna(wrong["class"])
    counts = table.groupby(["picture", "class"]).object.count().unstack()
    assert counts["red"].tolist() == [1, 1, 1, 0]
    assert counts["wine glass"].tolist() == [0, 0, 0, 0]
    numbers = table[["expected", "expected_error", "expected_guessed"]]
    assert numbers.isna().all(axis=None)  # a score tells no number in all
    assert run("find", folder / "d.png", "--out", tmp_path / "none.csv")[0] == 0
    none = pd.read_csv(tmp_path / "none.csv")
    assert (none.columns.tolist(), len(none)) == (table.columns.tolist(), 1)


def test_a_table_tells_which_expected_numbers_are_guesses():
    objects = [{"class": "cup", "object": number} for number in range(2)]
    numbers = {"expected": {"cup": 9.0, "cat": 2.0}, "expected_error": {"cup": 11.0, "cat": 0.5}}
    picture = {"picture": "a.jpg", "width": 8, "height": 6, "targets": ["cup", "cat"], "objects": objects, **numbers}
    guessed = {**picture, "expected_guessed": {"cup": True, "cat": False}}
    table = pd.read_csv(io.StringIO(Csv().text([{"picture": guessed}])))
    assert table[["class", "expected_guessed"]].to_numpy().tolist() == [["cup", True], ["cup", True], ["cat", False]]


def test_lines_of_json_are_written_as_pictures_are_done(run, folder, tmp_path):
    file = tmp_path / "found.jsonl"
    assert run("find", folder, "--target", "red", "--out", file)[0] == 0
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    assert [row["picture"] for row in rows] == [str(folder / f"{name}.png") for name in "abc"]
    code, printed = run("find", folder, "--target", "red", "--out", "-")
    assert code == 0
    streamed = [json.loads(line) for line in printed.out.splitlines()]
    assert [row["objects"] for row in streamed] == [row["objects"] for row in rows]
    assert "3 pictures: 3 looked at" in printed.err
    assert {path.name for path in tmp_path.iterdir()} == {"my photo.png", "photos", "found.jsonl"}


def test_output_of_another_encoding_has_escapes(run, photo, tmp_path, monkeypatch):
    path = photo.rename(tmp_path / "Küche.png")
    for options, expected in (((), "K\\xfcche.png, 160 \\xd7 120 px"), (("--out", "-"), "K\\u00fcche.png")):
        stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
        with monkeypatch.context() as patch:
            patch.setattr(sys, "stdout", stream)
            assert run("find", path, "--target", "red", *options)[0] == 0
        stream.seek(0)
        assert expected in stream.read()


def test_quiet_prints_nothing_but_results_and_errors(run, photo, tmp_path):
    code, printed = run("search", photo, "--target", "red", "--quiet", "--report", tmp_path / "page.html")
    assert (code, printed.out, printed.err) == (0, "", "")
    _, printed = run("search", photo, "--target", "red", "--quiet", "--out", "-")
    assert json.loads(printed.out)["outcome"] == "found"
    assert printed.err == ""
    code, printed = run("search", tmp_path / "missing.png", "--target", "red", "--quiet")
    assert (code, printed.out) == (1, "")
    assert "missing.png" in printed.err


def test_files_that_cannot_be_written_are_told_before_the_first_look(run, photo, tmp_path, agent, monkeypatch):
    monkeypatch.setattr(agent, "explore", lambda *_, **__: pytest.fail("it looked"))
    (tmp_path / "page.html").mkdir()
    for words in (("--report", tmp_path / "page.html"), ("--report", photo / "page.html"), ("--out", photo / "a.csv")):
        code, printed = run("explore", photo, *words)
        assert code == 1
        assert "is not a folder" in printed.err or "expected a file, got a folder" in printed.err
        assert not printed.out


def untimed(file):
    """A file of results without the times of the looks."""
    text = file.read_text(encoding="utf-8")
    return re.sub(r'"seconds": [\d.]+|,[\d.]+$', "", text, flags=re.M)


@pytest.mark.parametrize("kind", ["json", "coco.json"])
def test_a_folder_that_was_interrupted_continues(run, folder, tmp_path, agent, monkeypatch, kind):
    find_all, calls = agent.find_all, []

    def counted(picture, *arguments, **options):
        calls.append(picture)
        if stopped and len(calls) == 3:
            raise KeyboardInterrupt
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", counted)
    stopped, parts, whole = False, tmp_path / f"parts.{kind}", tmp_path / f"whole.{kind}"
    assert run("find", folder, "--out", whole)[0] == 0
    calls.clear()
    stopped = True
    draw = ("--draw", "scanpath")
    code, printed = run("find", folder, "--out", parts, *draw)
    assert (code, printed.err.splitlines()[-1], len(written_files(printed))) == (130, "interrupted", 3)
    assert kind != "json" or len(json.loads(parts.read_text())["pictures"]) == 2
    stopped = False
    calls.clear()
    code, printed = run("find", folder, "--out", parts, *draw)
    assert code == 0
    assert calls == [str(folder / "c.png")]
    assert "continuing: 2 of 3 pictures were looked at before" in printed.out
    assert "3 pictures: 3 looked at" in printed.out
    assert untimed(parts) == untimed(whole)
    assert len(written_files(printed)) == 4  # the figures, too
    assert {path.name for path in tmp_path.iterdir()} == {"my photo.png", "photos", "parts", parts.name, whole.name}


def test_only_what_is_as_before_counts_as_finished(run, folder, tmp_path, agent, monkeypatch):
    """After a picture has changed, it is looked at again; other options are those of another command."""
    find_all, calls = agent.find_all, []

    def stopping(picture, *arguments, **options):
        calls.append(picture)
        if picture.endswith("c.png"):
            raise KeyboardInterrupt
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", stopping)
    command = ("find", folder, "--out", tmp_path / "boxes.json")
    for more, seen in (((), "abc"), ((), "c"), (("--workers", 1), "c")):
        calls.clear()
        assert run(*command, *more)[0] == 130
        assert [name[-5] for name in calls] == list(seen)
    (folder / "a.png").write_bytes((folder / "b.png").read_bytes())
    calls.clear()
    assert run(*command)[0] == 130
    assert [name[-5] for name in calls] == ["a", "c"]


def test_what_another_command_has_finished_is_not_lost(run, folder, photo, tmp_path, agent, monkeypatch):
    """A command that was stopped keeps its pictures until it has ended, whatever would write the same file."""
    find_all, calls, last = agent.find_all, [], "a.png"

    def stopping(picture, *arguments, **options):
        calls.append(picture)
        if picture.endswith(last):
            raise KeyboardInterrupt
        return find_all(picture, *arguments, **options)

    monkeypatch.setattr(agent, "find_all", stopping)
    out, kept = tmp_path / "boxes.jsonl", tmp_path / "boxes.jsonl.unfinished"
    assert run("find", folder, "--target", "wine glass", "--out", out)[0] == 130
    last = "c.png"
    command = ("find", folder, "--target", "red", "--out", out)
    assert run(*command)[0] == 130  # of the first one nothing was done
    before = out.read_text()
    elsewhere = shutil.copytree(folder, tmp_path / "others")
    calls.clear()
    for words in ((folder, "--target", "wine glass"), (elsewhere, "--target", "red"), (photo, "--target", "red")):
        code, printed = run("find", *words, "--out", out)
        assert code == 1
        assert f"cannot write {out}: a command with other options, models or pictures" in printed.err
        assert f"2 pictures, which are kept in {kept}; name another output, or delete that folder" in printed.err
    assert (calls, out.read_text()) == ([], before)
    last = "none"
    assert run(*command)[0] == 0
    assert calls == [str(folder / "c.png")]
    assert run("find", folder, "--target", "wine glass", "--out", out)[0] == 0  # a file that is finished is replaced
    assert out.read_text() != before
    assert not kept.exists()


def test_outcomes_of_another_model_are_not_continued(folder, tmp_path, capsys, monkeypatch):
    """A file is replaced after the command was stopped: detector, weights, folder of models, or word vectors."""
    from semfov.agent import ActivePerception
    from semfov.cli.main import main

    home = tmp_path / "home"
    home.mkdir()
    network, out, calls = home / "colours.onnx", tmp_path / "boxes.json", []
    kept = tmp_path / "boxes.json.unfinished"

    def counted(self, picture, *arguments, **options):
        calls.append(picture)
        if stopped and len(calls) == 3:
            raise KeyboardInterrupt
        return look(self, picture, *arguments, **options)

    def pictures(name, *arguments):
        calls.clear()
        with monkeypatch.context() as patch:
            patch.setattr(ActivePerception, name, counted)
            code = main([{"find_all": "find", "search": "search"}[name], str(folder), *map(str, arguments)])
        capsys.readouterr()
        return code, len(calls)

    look = ActivePerception.find_all
    find = (
        "--agent",
        "raw",
        "--detector",
        network,
        "--how",
        "fovea",
        "--shifts",
        2,
        "--score-threshold",
        0.001,
        "--out",
        out,
    )
    write_network(network)
    stopped = False
    assert pictures("find_all", *find) == (0, 3)
    first = untimed(out)
    stopped = True
    write_network(network, -4.0)
    assert pictures("find_all", *find) == (130, 3)
    write_network(network, -2.0)
    assert pictures("find_all", *find) == (1, 0)
    shutil.rmtree(kept)
    assert pictures("find_all", *find) == (130, 3)
    stopped = False
    assert pictures("find_all", *find) == (0, 1)
    continued = untimed(out)
    assert pictures("find_all", *find) == (0, 3)
    assert continued == untimed(out) != first

    look, vectors = ActivePerception.search, tmp_path / "vectors.txt"
    described = (
        *(word for word in find if word not in ("--score-threshold", 0.001)),
        "--target",
        "crimson",
        "--embeddings",
        vectors,
    )
    stopped = True
    for line, ending in (("crimson 1 0.9", (130, 3)), ("crimson 0.9 1", (1, 0))):
        vectors.write_text(f"red 1 0.8\ngreen 0.8 1\nblue 0 1\n{line}\n")
        assert pictures("search", *described) == ending


@pytest.mark.slow
def test_processes_share_the_pictures_of_a_folder(folder, tmp_path, capsys):
    from semfov.cli.main import main

    detector = write_network(tmp_path / "colours.onnx")
    (folder / "d.png").write_bytes(b"no picture")
    common = ["find", str(folder), "--agent", "raw", "--detector", str(detector), "--how", "fovea", "--shifts", "2"]
    for workers in ("1", "2"):
        assert main([*common, "--workers", workers, "--out", str(tmp_path / f"{workers}.json")]) == 1
        assert "4 pictures: 3 looked at; 1 skipped" in capsys.readouterr().out
    assert untimed(tmp_path / "1.json") == untimed(tmp_path / "2.json")


def test_a_large_picture_is_looked_at_in_windows_and_closely(run, large, agent, evidence, tmp_path):
    evidence.places = Thresholds(0.4, 0.0, 0.0)
    agent.windows = evidence
    search = ("search", large, "--target", "red", "--passes", 5, "--looks")
    code, printed = run(*search, "--out", tmp_path / "out", "--report", tmp_path / "page.html")
    assert code == 0
    assert re.search(r"found red at \(10\d\d, 7\d\d\), box \S+, .*: 0\.\d\d$", printed.out, re.M)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"results.json", "scanpath.png", "animation.gif"}
    (episode,) = episodes_of(tmp_path / "page.html")
    assert len(episode["looks"]) == int(episode["passes"])
    _, printed = run(*search, "--closer", 0)
    assert "closer look" not in printed.out
    undecided = ("--confirm", 1, "--stop-below", 0, "--passes", 3, "--closer", 0)
    _, printed = run("search", large, "--target", "red", *undecided, "--out", tmp_path / "place.csv")
    # The red square is at 1000, 700 to 1040, 740.
    place = re.search(r"red undecided, .*; best place: box (\d+),(\d+)–(\d+),(\d+), score 0\.\d\d$", printed.out, re.M)
    assert place
    assert [int(edge) for edge in place.groups()] == pytest.approx([1000, 700, 1040, 740], abs=8)
    with (tmp_path / "place.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert row["outcome"] == "undecided"
    box = [float(row[name]) for name in ("x1", "y1", "x2", "y2")]
    assert box == pytest.approx([1000, 700, 1040, 740], abs=8)


def test_remedies_are_in_the_words_of_the_command(run, large):
    for words, remedy in (
        (("--start", "5,5"), "use none, or --how fovea"),
        (("--shifts", 3), "use --passes, or --how fovea"),
    ):
        code, printed = run("search", large, "--target", "red", *words)
        assert code == 1
        assert remedy in printed.err
        assert "how=" not in printed.err


def test_a_folder_may_have_small_and_large_pictures(run, photo, large, agent, evidence, tmp_path):
    agent.windows = evidence
    photo.rename(large.with_name(photo.name))
    out, page = tmp_path / "out", tmp_path / "page.html"
    code, _ = run("search", large.parent, "--target", "red", "--passes", 2, "--out", out, "--report", page,
                  "--draw", "animation")  # fmt: skip
    assert code == 0
    assert [(each["name"], "looks" in each) for each in episodes_of(page)] == [
        ("field.png", True),
        ("my photo.png", False),
    ]
    assert (out / "000-field.png/animation.gif").is_file()
    assert (out / "001-my-photo.png/animation.gif").is_file()


@pytest.mark.parametrize("size", [(320, 160), (400, 300)], ids=["panorama", "flat"])
def test_a_head_looks_at_panoramas_and_flat_pictures(run, tmp_path, agent, monkeypatch, size):
    Image.new("RGB", size, (100, 100, 100)).save(tmp_path / "scene.png")
    scenes = []
    monkeypatch.setattr(type(agent), "explore", lambda self, scene, **options: scenes.append((scene, options)) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run("explore", tmp_path / "scene.png", "--how", "head", "--duration", 5)
    ((scene, options),) = scenes
    assert type(scene).__name__ == ("Panorama" if size == (320, 160) else "Flat")
    assert options["duration"] == 5


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        "search --target Boats",
        "find --target dog",
        "search --target boat --agent published --sensor published-narrow --shifts 1 --draw scanpath",
    ],
)
def test_the_agents_of_the_package_look_at_an_embedded_scene(options, tmp_path, capsys):
    from semfov.cli.main import main

    out = ["--out", str(tmp_path / "out"), "--report", str(tmp_path / "page.html")]
    with torch.random.fork_rng():
        assert main([*options.split(), *out]) == 0
    printed = capsys.readouterr().out
    assert "which comes with semfov" in printed
    assert (tmp_path / "out/scanpath.png").is_file()
    assert "<!DOCTYPE html>" in (tmp_path / "page.html").read_text(encoding="utf-8")


def test_words_of_warnings_cannot_steer_the_terminal(capsys, monkeypatch):
    """As of matplotlib, which names a letter of a file's name that its font lacks."""
    monkeypatch.setattr(semfov.cli.main, "_run", lambda *_: warnings.warn("no glyph \x1b[31m", stacklevel=1) or 0)
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        semfov.cli.main.main(["detectors"])
    assert capsys.readouterr().err == "warning: no glyph \\x1b[31m\n"
