"""The files of a small run of `python -m eval.calibration`."""

import csv

import pytest

from tests.lab.commands.table import small_run
from tests.small import cells_of

pytestmark = pytest.mark.usefixtures("few_samples")

BELIEFS = ["raw", "calibrated", "tempered", "learned", "semantic map"]
FILES = ("beliefs.md", "beliefs.csv", "beliefs.json")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run of four photographs on 3 × 2 cells with untrained models."""
    return small_run("eval.calibration", tmp_path_factory.mktemp("calibration"))


def test_run_writes_tables_sums_and_figures(finished):
    for name in ("calibration.md", "config.yaml", "reliability.png", "beliefs.png", *FILES):
        assert (finished / name).stat().st_size > 200
    rows = list(csv.DictReader((finished / "beliefs.csv").read_text().splitlines()))
    whole = [row for row in rows if row["cells"] == "all"]
    assert [(row["belief"], row["looks"]) for row in whole] == [(b, n) for b in BELIEFS for n in ("1", "5")]
    # Four present and two absent classes, as two photographs hold all three: 6 searches of 6 cells.
    assert {row["count"] for row in whole} == {"36"}
    assert {row["count"] for row in rows if (row["looks"], row["cells"]) == ("5", "fixated")} == {"30"}
    text = (finished / "beliefs.md").read_text()
    assert "6 searches" in text
    assert "4 of them for a class that is present" in text
    assert "half of the target classes are present" in text
    by_looks = cells_of(text)
    for row in whole:
        figures = [f"{float(row[name]):.4f}" for name in ("nll", "brier", "ece", "mean_probability", "rate")]
        shown = next(line for line in by_looks if line[:2] == [row["looks"], row["belief"]])
        assert [float(value) for value in shown[3:]] == pytest.approx([float(f) for f in figures], abs=1.01e-4)
