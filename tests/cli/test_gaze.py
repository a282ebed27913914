"""The command `semfov gaze`: what it prints and writes."""

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from semfov.cli.main import main
from semfov.data.fixations import by_picture, read_table
from semfov.gaze.saliency import FixationDensity
from semfov.io.manifest import Manifest
from semfov.paths import GazePrediction
from tests.refusals import refused, unusable
from tests.small import Shown, rand


@pytest.fixture
def run(monkeypatch, tmp_path, capsys, few_viewers):
    """Runs the command with a model for `Shown`; returns code, output and errors."""
    detector = Shown("colours", ("cup",), (416, 416), stride=32, square=8).eval()
    torch.manual_seed(0)
    model = FixationDensity({"backbone8": 3}, metadata={"detector": detector.settings()})
    monkeypatch.setattr(FixationDensity, "shipped", tmp_path / "models")
    model.save(tmp_path / "models/colours.safetensors")
    monkeypatch.setattr("semfov.cli.gaze.check_detector", lambda name: None)
    monkeypatch.setattr("semfov.cli.gaze.load_detector", lambda name, **options: detector)

    def call(*words):
        code = main(["gaze", *map(str, words)])
        return code, *capsys.readouterr()

    return call


@pytest.fixture
def photos(tmp_path):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number, size in enumerate([(120, 90), (80, 100)]):
        colours = np.random.default_rng(number).integers(256, size=(6, 6, 3), dtype=np.uint8)
        Image.fromarray(colours).resize(size).save(folder / f"{number}.png")  # figures of noise are slow to compress
    return folder


def test_scanpaths_and_a_page_of_several_pictures(run, photos, tmp_path):
    table, page = tmp_path / "gaze.csv", tmp_path / "gaze.html"
    code, out, err = run(photos, "--people", 4, "--seconds", 1.5, "--out", table, "--report", page)
    assert (code, err) == (0, "")
    assert out.count("look first at") == out.count("4 viewers drawn") == 2
    wide, high = out.split(f"{photos / '1.png'}: ")
    assert ("wider than high" in wide, "wider than high" in high) == (False, True)
    assert page.read_text(encoding="utf-8").count("wider than high") == 2  # in the overview, and at the picture
    assert str(table) in out
    assert str(page) in out
    people = by_picture(read_table(table))
    assert {name: len(some) for name, some in people.items()} == {"0.png": 4, "1.png": 4}
    assert {each.size for each in people["1.png"]} == {(80, 100)}
    html = page.read_text()
    assert "0.png" in html
    assert "Where people look first" in html
    assert "<script src" not in html
    assert "://" not in html.replace("http://www.w3.org/2000/svg", "")


def test_pictures_of_one_name_stay_apart_in_the_table_and_on_the_page(run, photos, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    Image.new("RGB", (50, 40)).save(other / "0.png")
    table, page = tmp_path / "gaze.csv", tmp_path / "gaze.html"
    assert run(photos, other / "0.png", "--people", 2, "--out", table, "--report", page)[0] == 0
    assert [f"<h2>{folder / '0.png'}</h2>" in page.read_text("utf-8") for folder in (photos, other)] == [True, True]
    sizes = {each.picture: each.size for each in read_table(table)}
    assert sizes == {str(photos / "0.png"): (120, 90), "1.png": (80, 100), str(other / "0.png"): (50, 40)}


def test_a_command_that_is_stopped_has_written_the_pictures_so_far_and_continues(run, photos, tmp_path, monkeypatch):
    made, looked = GazePrediction.of, []

    def stopped(detector, image, **options):
        looked.append(Path(options["source"]).name)
        if looked == ["0.png", "1.png"]:
            raise KeyboardInterrupt
        return made(detector, image, **options)

    def words(name):
        return photos, "--people", 2, "--out", tmp_path / f"{name}.csv", "--report", tmp_path / f"{name}.html"

    assert run(*words("whole"))[0] == 0
    monkeypatch.setattr(GazePrediction, "of", stopped)
    code, out, err = run(*words("parts"))
    assert code == 130
    assert {each.picture for each in read_table(tmp_path / "parts.csv")} == {"0.png"}
    assert "parts.csv" in out
    assert "1 of 2 pictures" in err
    assert run(*words("parts"))[0] == 0
    assert looked == ["0.png", "1.png", "1.png"]
    for kind in ("csv", "html"):
        assert (tmp_path / f"parts.{kind}").read_text() == (tmp_path / f"whole.{kind}").read_text()
    assert not [*tmp_path.glob("*.unfinished")]


def test_a_model_of_ones_own(run, photos, tmp_path):
    torch.manual_seed(1)
    other = FixationDensity({"backbone8": 3}, centre=-torch.rand(39, 52))
    other.save(tmp_path / "own/gaze.safetensors")
    models = [], ["--model", tmp_path / "own/gaze.safetensors"], ["--model", tmp_path / "own"]
    shipped, own, folder = (run(photos / "0.png", *words)[1] for words in models)
    assert "look first at" in own
    assert own != shipped
    assert own == folder
    assert "did you mean --model?" in run(photos / "0.png", "--models", tmp_path / "own")[2]
    unusable(r"semfov gaze --model .*own/gaze\.safetensors", Manifest.read, tmp_path / "own")
    detector = Shown("colours", ("cup",), (416, 416), stride=32, square=8).eval()
    image = rand(3, 60, 80)
    by_path = GazePrediction.of(detector, image, model=str(tmp_path / "own/gaze.safetensors"))
    torch.testing.assert_close(by_path.density, GazePrediction.of(detector, image, model=other).density)
    refused(r"model: expected .*from_pretrained", GazePrediction.of, detector, image, model=3)


def test_the_seed_repeats_the_table(run, photos, tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        assert run(photos, "--people", 2, "--seed", seed, "--out", tmp_path / f"{name}.csv")[0] == 0
    first, second, third = ((tmp_path / f"{name}.csv").read_text() for name in "abc")
    assert first == second != third


@pytest.mark.parametrize("name", ["density.npy", "density.tif", "map.png"])
def test_the_density_of_one_picture(run, photos, tmp_path, name):
    code, _, err = run(photos / "0.png", "--out", tmp_path / name)
    assert (code, err) == (0, "")
    if name == "density.npy":
        density = np.load(tmp_path / name)
        assert density.shape == (90, 120)
        assert density.sum() == pytest.approx(1, abs=1e-4)


def test_more_views_and_panoramas_are_asked_for(run, photos, tmp_path):
    densities = {}
    for quality in ("quick", "best"):
        out = tmp_path / f"{quality}.npy"
        assert run(photos / "0.png", "--quality", quality, "--people", 2, "--out", out)[0] == 0
        densities[quality] = np.load(out)
    assert not np.allclose(densities["quick"], densities["best"])
    strip = Image.open(photos / "0.png", formats=("PNG",)).resize((200, 100))
    strip.save(tmp_path / "strip.png")
    assert "--panorama" in run(tmp_path / "strip.png", "--people", 2)[1]
    code, out, err = run(tmp_path / "strip.png", "--panorama", "--people", 2)
    assert (code, err) == (0, "")
    assert "--panorama" not in out
    assert "panorama: expected" in run(photos / "0.png", "--panorama", "--people", 2)[2]


def test_a_folder_gets_scanpaths_and_heat_maps(run, photos, tmp_path):
    assert run(photos, "--out", tmp_path / "new")[0] == 0
    assert sorted(each.name for each in (tmp_path / "new").iterdir()) == [
        "000-0.png", "001-1.png", "pictures.csv", "scanpaths.csv"
    ]  # fmt: skip


def test_a_heat_map_that_is_gone_is_written_again(run, photos, tmp_path, monkeypatch):
    made, out = GazePrediction.of, tmp_path / "new"

    def stopped(detector, image, **options):
        if options["source"].endswith("1.png"):
            raise KeyboardInterrupt
        return made(detector, image, **options)

    with monkeypatch.context() as patch:
        patch.setattr(GazePrediction, "of", stopped)
        assert run(photos, "--people", 2, "--seconds", 1, "--out", out)[0] == 130
    (out / "000-0.png").unlink()
    assert run(photos, "--people", 2, "--seconds", 1, "--out", out)[0] == 0
    assert sorted(each.name for each in out.iterdir()) == [
        "000-0.png", "001-1.png", "pictures.csv", "scanpaths.csv"
    ]  # fmt: skip


def test_areas_are_told_drawn_and_in_the_table(run, photos, tmp_path):
    """A line for each picture; words after the option are areas as long as they look like one."""
    areas = "top:0,0,80,45", "left:0,0,40,90"
    page = tmp_path / "gaze.html"
    code, out, err = run(photos, "--areas", *areas, "--people", 2, "--out", tmp_path / "a.csv", "--report", page)
    assert (code, err) == (0, "")
    with (tmp_path / "a-pictures.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["picture"], row["width"], row["unlike"]) for row in rows] == [
        ("0.png", "120", "False"), ("1.png", "80", "False")
    ]  # fmt: skip
    caution = "the model learned only from pictures that are wider than high, and this one is not"
    assert [row["caution"] for row in rows] == ["", caution]
    assert run(photos / "0.png", "--people", 2, "--out", tmp_path / "density.npy")[0] == 0
    density = np.load(tmp_path / "density.npy")
    assert float(rows[0]["share of top"]) == pytest.approx(float(density[:45, :80].sum()), abs=1e-4)
    assert float(rows[0]["share of left"]) == pytest.approx(float(density[:, :40].sum()), abs=1e-4)
    percent = f"{100 * float(rows[0]['share of left']):.0f} %"
    share = f"left: {percent} of all fixations, seen by "
    assert out.count(share) == 1
    assert f"left {percent}" in page.read_text(encoding="utf-8")
    seen = f"{100 * float(rows[0]['viewers of left']):.0f} %"
    assert f"{share}{seen} of viewers, by these first after " in out
    assert f"<td>left</td><td>{percent}</td><td>{seen}</td>" in page.read_text(encoding="utf-8")
    assert 0 <= float(rows[0]["seconds to left"]) < 3
    (tmp_path / "areas.json").write_text('{"top": [0, 0, 80, 45], "left": [0, 0, 40, 90]}')
    assert run(photos, "--areas", tmp_path / "areas.json", "--people", 2)[1].count(share) == 1
    assert run(photos, "--areas", " ".join(areas), "--people", 2)[1].count(share) == 1


def test_two_drafts_are_compared(run, photos, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = photos / "0.png", photos / "1.png", "--compare", "--people", 2
    code, out, err = run(*words)
    assert (code, err) == (0, "")
    assert "their proportions differ" in out
    assert "The two drafts" in (tmp_path / "semfov-compare.html").read_text(encoding="utf-8")
    Image.new("RGB", (120, 90), "white").save(photos / "1.png")
    code, out, err = run(*words, "--areas", "top:0,0,120,45", "--out", tmp_path / "map.png", "--report", "x.html")
    assert (code, err) == (0, "")
    assert "of the fixations are elsewhere in the second" in out
    assert "% of all fixations\n" in out
    with Image.open(tmp_path / "map.png") as figure:
        assert figure.size[0] > 2 * figure.size[1]  # three panels
    assert "of the fixations move between the drafts" in (tmp_path / "x.html").read_text(encoding="utf-8")
    assert run(*words, "--out", tmp_path / "new")[0] == 0
    assert {"compare.png", "000-0.png", "scanpaths.csv"} <= {each.name for each in (tmp_path / "new").iterdir()}


def test_a_damaged_picture_of_several_is_skipped(run, photos, tmp_path):
    (photos / "2.png").write_bytes(b"no picture")
    code, out, err = run(photos, "--out", tmp_path / "gaze.csv")
    assert code == 1
    assert "skipped" in err
    assert "2.png" in err
    assert out.count("look first at") == 2


def test_a_fault_at_one_picture_of_several_is_not_the_end(run, photos, tmp_path, monkeypatch):
    scanpaths = GazePrediction.scanpaths

    def fails(prediction, *arguments, **options):
        if prediction.name.endswith("1.png"):
            raise KeyError("a fault of the code")
        return scanpaths(prediction, *arguments, **options)

    monkeypatch.setattr(GazePrediction, "scanpaths", fails)
    code, out, err = run(photos, "--out", tmp_path / "gaze.csv")
    assert (code, out.count("look first at")) == (1, 1)
    assert "1.png: cannot be looked at (KeyError: 'a fault of the code')" in err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--out", "gaze.pdf"], "a folder, or a file .csv"),
        (["--out", "density.npy"], "a .csv file or a folder for several pictures"),
        (["--report", "gaze.pdf"], ".html"),
        (["--people", "0"], "people"),
        (["--areas", "logo"], "NAME:LEFT,TOP,RIGHT,BOTTOM"),
        (["--compare", "--out", "density.npy"], ".csv or .png"),
    ],
)
def test_wrong_options_are_told_before_a_look(run, photos, words, told):
    code, out, err = run(photos, *words)
    assert code != 0
    assert told in err
    assert "look first at" not in out


def test_a_comparison_takes_two_pictures(run, photos):
    Image.new("RGB", (50, 40)).save(photos / "2.png")
    for pictures in ((photos / "0.png",), (photos,)):
        code, _, err = run(*pictures, "--compare")
        assert code == 1
        assert "compare: expected two pictures" in err
        assert "without it the page of several pictures has the shares side by side" in err


def test_a_detector_without_a_model_is_told(run, photos, monkeypatch):
    other = Shown("other", ("cup",), (416, 416), stride=32, square=8).eval()
    monkeypatch.setattr("semfov.cli.gaze.load_detector", lambda name, **options: other)
    code, _, err = run(photos / "0.png")
    assert code == 1
    assert "semfov fit MODEL --gaze.fixations" in err
    assert "colours" in err


def test_without_a_picture_it_takes_an_embedded_scene(run, tmp_path):
    code, out, _ = run("--people", 2, "--out", tmp_path / "gaze")
    assert code == 0
    assert "looking at example:beach, which comes with semfov" in out
    assert {path.name for path in (tmp_path / "gaze").iterdir()} == {"beach.png", "pictures.csv", "scanpaths.csv"}
