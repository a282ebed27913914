"""Films in which windows open: what a look has shown stays as sharp as it was seen."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from semfov.viz.opening import opening_frames

LINE = 3  # pixels of the line around a window


def looked(*region: float, boxes: tuple[tuple[float, ...], ...] = ()) -> SimpleNamespace:
    """A record whose last look had a region."""
    found = SimpleNamespace(boxes=torch.tensor(boxes).reshape(-1, 4))
    return SimpleNamespace(looks=[SimpleNamespace(region=region)], objects=found)


@pytest.fixture
def picture():
    pixels = np.random.default_rng(0).integers(256, size=(100, 200, 3), dtype=np.uint8)
    return Image.fromarray(pixels)


def frames_of(records, picture, input_size, width=200):
    captions = ["some found"] * len(records)
    return [np.asarray(frame) for frame in opening_frames(records, picture, input_size, captions, width)]


def test_a_window_is_sharp_where_the_input_is_as_large_and_the_rest_stays_as_it_was(picture):
    whole = looked(0, 0, 200, 100)
    first, second = frames_of([whole, looked(50, 20, 100, 70)], picture, (50, 50))
    inside = np.s_[20 + LINE : 70 - LINE, 50 + LINE : 100 - LINE]
    assert np.array_equal(second[inside], np.asarray(picture)[inside])
    # Noise that is seen at a quarter of its size has lost most of its contrast.
    assert first[inside].std() < 0.6 * np.asarray(picture)[inside].std()
    right = np.s_[LINE : 100 - LINE, 101 + LINE : 200 - LINE]
    assert np.array_equal(first[right], second[right])


def test_windows_and_objects_are_drawn_where_they_are(picture):
    box = (110.0, 30.0, 150.0, 80.0)
    (frame,) = frames_of([looked(20, 10, 90, 60, boxes=(box,))], picture, (400, 400), width=400)
    window, found = frame[20, 40], frame[60, 220]  # their left upper corners, at twice the size
    assert window.tolist() == [255, 191, 0]
    assert found.tolist() == [0, 128, 96]
    nothing_yet = frame[100, 320]  # no look has been there
    assert nothing_yet.tolist() == [0, 0, 0]
    assert frame.shape[0] > 200  # a line with the number of the look is below the picture
    assert frame[201:].min() < 128
