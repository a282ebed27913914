"""`python -m eval.human` as a user runs it: small, on pictures drawn for the test, with the real detector."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from eval.human import main
from semfov import EmbeddedScenes
from semfov.data.fixations import Fixations, read_table, write_ruarte, write_table

pytest.importorskip("rapidfuzz")
pytest.importorskip("sklearn")
SIZE = (240, 180)


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Four pictures, five people's fixations in each, and two people's searches with a model's."""
    folder = tmp_path_factory.mktemp("human")
    (folder / "images").mkdir()
    generator = np.random.default_rng(0)
    scenes = EmbeddedScenes(("person", "cup"), count=4, seed=0)
    viewed, searched = [], {"a": [], "b": [], "model": []}
    for number in range(4):
        pixels = (scenes[number].image.permute(1, 2, 0) * 255).byte().numpy()
        name = f"{number}.png"
        Image.fromarray(pixels).resize(SIZE).save(folder / "images" / name)
        for person in range(5):
            points = generator.uniform(0, np.array(SIZE) - 1, (generator.integers(2, 6), 2))
            viewed.append(Fixations(name, str(person + 1), points, SIZE))
        for who, found in searched.items():
            points = generator.uniform(0, (320, 180), (4, 2))
            box = (150.0, 60.0, 200.0, 120.0)
            found.append(Fixations(name, who, points, (320, 180), None, "cup", box, bool(generator.random() < 0.7)))
    write_table(folder / "viewed.csv", viewed)
    (folder / "people").mkdir()
    for who in ("a", "b"):
        write_ruarte(folder / "people" / f"{who}.json", searched[who])
    write_table(folder / "model.csv", searched["model"])
    write_table(folder / "others.csv", [each for each in viewed if each.subject == "2"])
    return folder


def viewing(folder: Path, out: str, *more: str) -> list[str]:
    return [
        "viewing", "--people", str(folder / "viewed.csv"), "--data.root", str(folder / "images"),
        "--belief.columns", "4", "--belief.rows", "3", "--density.columns", "8", "--density.rows", "6",
        "--density.blurs", "[0, 1]", "--policies", "[kl-calibrated, objects-raw]", "--workers", "1",
        "--sequences", "[random, vocus2, landing, kl-calibrated]", "--cache", str(folder / "cache"),
        "--files", f"[{folder / 'others.csv'}]", "--out", str(folder / out), *more,
    ]  # fmt: skip


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def finished(pictures):
    assert main(viewing(pictures, "viewing")) == 0
    return pictures / "viewing"


@pytest.mark.weights
def test_every_row_is_present_and_random_rows_are_at_chance(finished):
    table = {(row["row"], row["group"], row["figure"]): float(row["mean"]) for row in rows(finished / "summary.csv")}
    names = {"kl-calibrated", "objects-raw", "landing", "vocus2", "itti-koch", "landing + vocus2", "other people"}
    for name in names:
        for group in ("alone", "with habits"):
            assert np.isfinite(table[name, group, "NSS"])
            assert 0 <= table[name, group, "AUC"] <= 1
    assert table["random", "alone", "NSS"] == 0
    assert table["random", "alone", "AUC"] == 0.5
    assert table["random", "alone", "log likelihood"] == pytest.approx(0, abs=1e-5)
    assert ("nearby", "with habits", "NSS") in table


@pytest.mark.weights
def test_more_terms_do_not_fit_the_fitted_half_worse(finished):
    bits = {(row["row"], row["group"]): float(row["bits of the fitted half"]) for row in rows(finished / "weights.csv")}
    for name in ("kl-calibrated", "landing", "vocus2"):
        assert bits[name, "with habits"] >= bits["nearby", "with habits"] - 1e-3
        assert bits[name, "with habits"] >= bits[name, "alone"] - 1e-3


@pytest.mark.weights
def test_figures_come_from_the_held_out_half(finished):
    written = {row["picture"] for row in rows(finished / "pictures.csv")}
    assert written == {"1.png", "3.png"}
    assert len({row["row"] for row in rows(finished / "sequences.csv")}) == 6
    summary = (finished / "summary.md").read_text()
    assert "2 pictures" in summary
    manifest = json.loads((finished / "manifest.json").read_text())
    assert manifest["command"][:3] == ["python", "-m", "eval.human"]
    assert (finished / "nss_by_shift.png").stat().st_size > 5000
    assert {path.name for path in finished.glob("scanpaths_*.png")} == {"scanpaths_1.png", "scanpaths_3.png"}


@pytest.mark.slow
@pytest.mark.weights
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
    assert names == {"people", "model", "random draws", "centre draws", "random", "non-predictive-raw"}
    paths = read_table(out / "scanpaths" / "non-predictive-raw.csv")
    assert len(paths) == 4
    # All start in the cell of the screen's first fixation, and end at the target or after nine gaze shifts.
    assert {tuple(path.points[0].tolist()) for path in paths} == {(179.5, 89.5)}
    assert all(path.found or len(path) == 10 for path in paths)
    curve = [float(row["found"]) for row in rows(out / "curves.csv") if row["row"] == "people"][:10]
    assert curve == sorted(curve)


def test_an_unknown_job_is_refused_with_the_names_of_jobs(capsys):
    assert main(["dance"]) == 2
    assert "search or viewing" in capsys.readouterr().err
    assert main(["--help"]) == 0
