"""Planted faults: pictures of two places each at which people look."""

import numpy as np
import pytest
import torch

from eval import content
from eval.content import ContentConfig, measure
from semfov.data.fixations import Fixations, write_osie, write_table
from semfov.errors import InputError


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """Writes recordings in frames of a size, with the densities from which they are drawn; returns the records."""

    def record(size):
        rng = np.random.default_rng(0)
        scale = np.array(size) / (800, 600)
        densities = {}
        records = []
        y, x = np.mgrid[0:45, 0:60]
        cells = np.stack([(x + 0.5) * 800 / 60, (y + 0.5) * 600 / 45], -1)
        for number in range(16):
            name = f"{number:02}.png"
            centres = rng.uniform([150, 150], [650, 450], (2, 2))
            density = sum(np.exp(-((cells - centre) ** 2).sum(-1) / 2 / 35**2) for centre in centres) + 0.01
            densities[name] = torch.from_numpy(density / density.sum())
            for person in range(5):
                points = centres[rng.integers(0, 2, 12)] + rng.normal(0, 30, (12, 2))
                records.append(Fixations(name, str(person), points * scale, size, np.full(12, 200.0)))
        monkeypatch.setattr(content, "_densities", lambda config, names: (densities, dict.fromkeys(names, size)))
        return records

    return record


def rows_of(lines):
    """The rows of a table by their first cells."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {row[0]: row for row in rows if len(row) > 1}


def test_the_table_says_how_often_an_offset_is_right(recorded, tmp_path):
    write_table(tmp_path / "people.csv", recorded((800, 600)))
    rows = rows_of(measure(ContentConfig(fixations=tmp_path / "people.csv", sets=1, size=16)))
    within = rows["fault"].index("offset right within 10 px")
    assert rows["shifted by (60, 60)"][1:3] == ["1.00", "1.00"]
    assert rows["one person shifted by (70, -50)"][within] == "1.00"
    assert rows["y upwards"][1:3] == ["1.00", ""]
    assert rows["none"][1] == "0.00"


def test_a_frame_without_a_height_is_named_by_its_option(tmp_path):
    with pytest.raises(InputError, match="frame: expected a width and a height, as 1920,1080, got '640'"):
        measure(ContentConfig(fixations=tmp_path / "people.json", frame="640"))


def test_a_file_without_a_frame_is_given_one_and_a_page_its_table(recorded, tmp_path):
    write_osie(tmp_path / "people.json", recorded((640, 480)))
    page = tmp_path / "page.md"
    page.write_text("# Checks\n\n<!-- table content -->\n\nold\n\n<!-- end -->\n\nThe rest.\n")
    files = {"fixations": tmp_path / "people.json", "page": page, "out": tmp_path / "out"}
    content.run(ContentConfig(frame="640x480", sets=1, size=16, **files))
    text = page.read_text()
    assert "old" not in text
    assert text.endswith("<!-- end -->\n\nThe rest.\n")
    rows = rows_of(text.splitlines())
    assert rows["none"][1] == "0.00"
    assert rows["y upwards"][1] == "1.00"
    assert (tmp_path / "out" / "summary.md").read_text() in text
    # In frames of OSIE's size, which the file is read in by itself, nothing is right.
    wrong = rows_of(measure(ContentConfig(fixations=tmp_path / "people.json", sets=1, size=16)))
    assert wrong["none"][1] == "1.00"
