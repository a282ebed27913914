"""Planted faults: pictures of two places each at which people look."""

import numpy as np
import torch

from eval import content
from eval.content import ContentConfig, measure
from semfov.data.fixations import Fixations, write_table

SIZE = (800, 600)


def test_the_table_says_how_often_an_offset_is_right(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
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
            records.append(Fixations(name, str(person), points, SIZE))
    write_table(tmp_path / "people.csv", records)
    monkeypatch.setattr(content, "_densities", lambda config, names: (densities, dict.fromkeys(names, SIZE)))

    lines = measure(ContentConfig(fixations=tmp_path / "people.csv", sets=1, size=16)).splitlines()

    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    within = rows[0].index("offset right within 10 px")
    by_fault = {row[0]: row for row in rows[2:]}
    assert by_fault["shifted by (60, 60)"][1:3] == ["1.00", "1.00"]
    assert by_fault["one person shifted by (70, -50)"][within] == "1.00"
    assert by_fault["y upwards"][1:3] == ["1.00", ""]
    assert by_fault["none"][1] == "0.00"
