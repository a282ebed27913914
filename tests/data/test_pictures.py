"""Photographs without annotations."""

import hashlib

import pytest
import torch
from PIL import Image

from semfov.data.pictures import Pictures
from tests.refusals import unusable


@pytest.fixture
def folder(tmp_path):
    for number, name in enumerate(("b.png", "a.png")):
        Image.new("RGB", (8 + number, 6), (255 * number, 0, 0)).save(tmp_path / name)
    return tmp_path


def test_digests_depend_on_the_content_of_the_files(folder):
    pictures = Pictures(folder, ["a.png", "b.png"], ("person",))
    assert pictures.digest(0) == hashlib.sha256((folder / "a.png").read_bytes()).hexdigest()
    before = pictures.fingerprint
    assert before == Pictures(folder, ["b.png", "a.png"], ("person",)).fingerprint
    (folder / "b.png").write_bytes((folder / "a.png").read_bytes())
    assert pictures.fingerprint != before


def test_pictures_are_sorted_by_name_and_lie_in_the_folder(folder):
    pictures = Pictures(folder, ["b.png", "a.png", "b.png"], ("person", "cup"))
    assert pictures.ids == ["a.png", "b.png"]
    assert [pictures[index].image.shape for index in range(2)] == [(3, 6, 9), (3, 6, 8)]
    assert pictures[0].image[0].eq(1).all()
    assert pictures.annotation(0).size == (9, 6)
    assert torch.equal(pictures.annotation(0).boxes, torch.zeros(0, 4))
    assert pictures.targets(0) == []
    for name in ["missing.png", "../a.png"]:
        unusable(r"missing\.png|leads out", Pictures, folder, ["a.png", name], ("person",))
