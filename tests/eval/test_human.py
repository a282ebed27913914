"""`python -m eval.human` as a user runs it: small, on pictures drawn for the test, with the real detector."""

import csv

import numpy as np
import pytest
from PIL import Image

from eval.human import main
from eval.human.drawn_pictures import KINDS
from eval.human.viewing import beside_others, filled
from semfov import EmbeddedScenes, example
from semfov.data.fixations import Fixations, read_table, write_ruarte, write_table
from semfov.metrics.scanpath import multimatch, time_delay_embedding

pytest.importorskip("rapidfuzz")
pytest.importorskip("sklearn")
SIZE = (240, 180)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Four pictures, and two people's searches in each with a model's."""
    folder = tmp_path_factory.mktemp("human")
    (folder / "images").mkdir()
    generator = np.random.default_rng(0)
    scenes = EmbeddedScenes(("person", "boat"), count=4, seed=0)
    searched = {"a": [], "b": [], "model": []}
    for number in range(4):
        pixels = (scenes[number].image.permute(1, 2, 0) * 255).byte().numpy()
        name = f"{number}.png"
        Image.fromarray(pixels).resize(SIZE).save(folder / "images" / name)
        for who, found in searched.items():
            points = generator.uniform(0, (320, 180), (4, 2))
            box = (150.0, 60.0, 200.0, 120.0)
            found.append(Fixations(name, who, points, (320, 180), None, "cup", box, bool(generator.random() < 0.7)))
    (folder / "people").mkdir()
    for who in ("a", "b"):
        write_ruarte(folder / "people" / f"{who}.json", searched[who])
    write_table(folder / "model.csv", searched["model"])
    return folder


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_tables_are_filled_into_their_places():
    page = "a\n<!-- table viewing -->\nold\n<!-- end -->\nb\n<!-- table other -->\nkept\n<!-- end -->\n"
    new = filled(page, {"viewing": ["| new |"]})
    assert new == page.replace("\nold\n", "\n\n| new |\n\n")


def test_scanpaths_are_compared_with_those_of_others():
    """Equal to the measures of each pair; the same scanpath by the same person is not a pair."""
    generator = np.random.default_rng(0)
    people = [generator.uniform(0, (239, 179), (count, 2)) for count in (4, 5, 3)]
    got = beside_others(people, people, (180, 240))
    pairs = [(a, b) for a in range(3) for b in range(3) if a != b]
    expected = np.mean([multimatch(people[a], people[b], (240, 180)).mean for a, b in pairs])
    assert got["MultiMatch"] == pytest.approx(expected)
    expected = np.mean([time_delay_embedding(people[a], people[b]) for a, b in pairs]) / 240
    assert got["time delay embedding"] == pytest.approx(expected)
    assert beside_others(people[:1], [people[1], people[0]], (180, 240))["sequence score"] == 1


@pytest.mark.slow
def test_searches_of_people_models_random_draws_and_policies_are_compared(pictures):
    out = pictures / "search"
    code = main(
        [
            "search", "--people", str(pictures / "people"), "--files", f"[{pictures / 'model.csv'}]",
            "--pictures", f"[{pictures / 'images'}]", "--screen.width", "320", "--screen.height", "180",
            "--screen.start", "[160, 90]", "--belief.columns", "8", "--belief.rows", "5", "--bandwidth", "40",
            "--policies", "[random, non-predictive-raw]", "--cache", str(pictures / "cache"), "--out", str(out),
            "--workers", "1",
        ]
    )  # fmt: skip
    assert code == 0
    table = rows(out / "summary.csv")
    titles = list(dict.fromkeys(row["table"] for row in table))
    assert titles == ["all 4 pictures", "the 4 available pictures"]
    names = {row["row"] for row in table if row["table"] == titles[1]}
    assert names == {"people", "model", "uniform scanpaths", "centre-bias scanpaths", "random", "non-predictive-raw"}
    paths = read_table(out / "scanpaths" / "non-predictive-raw.csv")
    assert len(paths) == 4
    # All start in the cell of the screen's first fixation, and end at the target or after nine gaze shifts.
    assert {tuple(path.points[0].tolist()) for path in paths} == {(179.5, 89.5)}
    assert all(path.found or len(path) == 10 for path in paths)
    curve = [float(row["found"]) for row in rows(out / "curves.csv") if row["row"] == "people"][:10]
    assert curve == sorted(curve)


def test_drawn_pictures_are_told_from_photographs(tmp_path, capsys):
    """The beach of the package in many crops is the fit, and the rest of its photographs are the others."""
    for folder, name in (("fit", "beach"), ("others", "market")):
        (tmp_path / folder).mkdir()
        pixels = example(name)
        for number in range(64 if folder == "fit" else 4):
            corner = 20 * (number % 8), 15 * (number // 8)
            crop = pixels[:, corner[1] : corner[1] + 180, corner[0] : corner[0] + 240]
            array = (crop * 255).byte().permute(1, 2, 0).numpy()
            Image.fromarray(array).save(tmp_path / folder / f"{number:02d}.png")
    page = tmp_path / "page.md"
    page.write_text("<!-- table unlike -->\n<!-- end -->\n")
    words = ["--fitted", f"[{tmp_path / 'fit'}]", "--others", str(tmp_path / "others"), "--detectors", "[yolox-nano]"]
    more = ["--count", "2", "--out", str(tmp_path / "out"), "--page", str(page)]
    assert main(["unlike", *words, *more]) == 0, capsys.readouterr().err
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in page.read_text().splitlines() if "|" in line]
    by_kind = {row[0]: row[1:] for row in cells[2:]}
    assert set(KINDS) <= set(by_kind)
    assert by_kind["flat pictures"][1] == "100 %"
    assert float(by_kind["flat pictures"][0]) > 0.9
    shipped = ["--others", str(tmp_path / "others"), "--detectors", "[yolox-nano]", "--limit", "2", *more]
    assert main(["unlike", *shipped]) == 0, capsys.readouterr().err
    assert "photographs like those of the fit" not in page.read_text()
    assert main(["unlike"]) != 0
    assert "others: expected a folder" in capsys.readouterr().err


@pytest.mark.parametrize("kind", [*KINDS])
def test_pictures_are_drawn_from_their_seed(kind):
    first, again, other = (np.array(KINDS[kind](np.random.default_rng(seed))) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert first.dtype == np.uint8
    assert first.ndim == 3
    assert first.shape != other.shape or not np.array_equal(first, other)


def test_an_unknown_job_is_refused_with_the_names_of_jobs(capsys):
    assert main(["dance"]) == 2
    assert "search or viewing or unlike" in capsys.readouterr().err
    assert main(["--help"]) == 0
