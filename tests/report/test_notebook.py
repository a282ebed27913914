"""A scanpath in a notebook: the page is shown in a frame, and its size is limited."""

import html
import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest
import torch

from semfov import Grid
from semfov.detection import Placement
from semfov.paths.stimulus import Stimulus, in_bytes
from semfov.report import notebook
from tests import small
from tests.report.pages import data_of


class Frame(HTMLParser):
    """The elements in the output of a cell."""

    def __init__(self, text):
        super().__init__()
        self.tags = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))


def with_photograph(scanpath, image):
    """The scanpath with its photograph."""
    height, width = image.shape[-2:]
    sensor = {"sigma": 20.0, "levels": 2, "growth": 2.0, "convention": "kornia", "reference": 640.0}
    settings = {"sensor": sensor, "detector": {"name": "none"}}
    placement = Placement((80, 60), (width / 80, height / 60), (0, 0))
    pixels = in_bytes(image)
    return replace(scanpath, photograph=pixels, stimulus=Stimulus(pixels, placement, settings))


def test_the_frame_contains_the_page(scanpath, image, hostile):
    text = with_photograph(scanpath, image)._repr_html_()
    ((tag, attributes),) = Frame(text).tags
    assert tag == "iframe"
    assert attributes["sandbox"] == "allow-scripts"
    assert hostile in attributes["title"]
    page = attributes["srcdoc"]
    assert page.startswith("<!DOCTYPE html>")
    data = data_of(page)
    (episode,) = data["episodes"]
    assert len(episode["fixations"]) == 3
    assert (episode["name"], episode["detector"]) == ("80 × 60 px", "none")
    assert len(data["pictures"]) == 4
    assert html.unescape(re.search('srcdoc="([^"]*)"', text)[1]) == page


def test_without_a_photograph_there_are_no_pictures(scanpath):
    page = Frame(scanpath._repr_html_()).tags[0][1]["srcdoc"]
    data = data_of(page)
    assert data["pictures"] == []
    assert data["episodes"][0]["image"] is None
    assert data["episodes"][0]["detector"] is None


def scanpath_of(looks, columns, classes):
    grid = Grid(columns, columns, (80, 60))
    names = ("background", *(f"class {number}" for number in range(classes)))
    return small.scanpath(grid, torch.arange(looks) % len(grid), names, target=1)


@pytest.mark.parametrize(
    ("looks", "columns", "classes", "size", "shown"),
    [(31, 10, 80, 200, True), (120, 10, 80, 416, True), (31, 40, 80, 200, True), (900, 40, 2, 20, False)],
)
def test_the_size_of_the_output_is_limited(looks, columns, classes, size, shown):
    """If the output is too large: coarser pictures and fewer classes, then only text."""
    noise = torch.rand(3, size * 3 // 4, size)
    text = with_photograph(scanpath_of(looks, columns, classes), noise)._repr_html_()
    assert len(text.encode()) <= notebook._MOST_CHARACTERS
    if shown:
        episode = data_of(Frame(text).tags[0][1]["srcdoc"])["episodes"][0]
        assert len(episode["fixations"]) == looks
        labels = [each["label"] for each in episode["maps"]]
        assert labels[0] == "class 0"
        assert labels[-1] == "background"
    else:
        assert Frame(text).tags == [("pre", {})]
        assert "class 0" in text
