"""Fixations that are drawn from known densities, and read wrongly in ways that are known."""

import re

import numpy as np
import pytest
import torch

from semfov.data.fixations import Fixations
from semfov.errors import InputError
from semfov.human import content_suspicions
from tests.families import first_of

FRAME = (800, 600)
PICTURES = 16
PEOPLE = 5
BY_ONE = 12  # fixations of a person in a picture


def blobs(seed):
    """Centres of three blobs of a picture in pixels, and the density of fixations `(45, 60)` that they make."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform([80, 60], [720, 540], (3, 2))
    y, x = np.mgrid[0:45, 0:60]
    cells = np.stack([(x + 0.5) * 800 / 60, (y + 0.5) * 600 / 45], -1)
    density = sum(np.exp(-((cells - centre) ** 2).sum(-1) / 2 / 35**2) for centre in centres) + 0.01
    return centres, torch.from_numpy(density / density.sum())


NAMES = [f"{number:02}.jpg" for number in range(PICTURES)]
CENTRES, DENSITIES = zip(*(blobs(number) for number in range(PICTURES)), strict=True)
BY_NAME = dict(zip(NAMES, DENSITIES, strict=True))
SIZES = dict.fromkeys(NAMES, FRAME)


def drawn(fault=lambda points, person, order: points, frame=FRAME, names=NAMES, seed=0):
    """Fixations around the blobs of each picture, read with a fault, under the names that are given."""
    rng = np.random.default_rng(seed)
    records = []
    for order, (name, centres) in enumerate(zip(names, CENTRES, strict=True)):
        for person in range(PEOPLE):
            points = centres[rng.integers(0, 3, BY_ONE)] + rng.normal(0, 30, (BY_ONE, 2))
            records.append(Fixations(name, str(person), fault(points, person, order), frame))
    return records


def at(scale, frame):
    """Points in a frame in whose middle the picture has a scale."""
    return lambda points, person, order: (points + 0.5 - 400 * np.array([1, 0.75])) * scale + np.array(frame) / 2 - 0.5


FAULTS = {
    "y ran upwards": (lambda points, person, order: points * [1, -1] + [0, 599], FRAME),
    "x ran from right to left": (lambda points, person, order: points * [-1, 1] + [799, 0], FRAME),
    "turned by half a circle": (lambda points, person, order: [799, 599] - points, FRAME),
    "y came before x": (lambda points, person, order: points[:, ::-1], FRAME),
    "shown at their own size": (at(1, (1920, 1080)), (1920, 1080)),
    "stretched over the frame": (lambda points, person, order: points * [2.1, 1.75], (1680, 1050)),
    "filled about 50 %": (at(0.5, FRAME), FRAME),
    "filled about 75 %": (at(0.75, FRAME), FRAME),
    "a frame of about 1280 × 960": (lambda points, person, order: points * 1.6, FRAME),
    "a frame of about 400 × 300": (lambda points, person, order: points / 2, FRAME),
    "all fixations lie about": (lambda points, person, order: points + 60, FRAME),
    "the fixations of person 3 lie about": (
        lambda points, person, order: points + np.array([70 * (person == 3), 0]),
        FRAME,
    ),
    "in the second half": (lambda points, person, order: points + np.array([6 * order, 0]), FRAME),
}


@pytest.mark.parametrize("seed", first_of(range(3)))
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_named(fault, seed):
    change, frame = FAULTS[fault]
    lines = content_suspicions(drawn(change, frame, seed=seed), BY_NAME, SIZES)
    assert [fault in line for line in lines] == [True]


PLACES = {
    "own size in a frame that a part would fit, too": (240, 212, 800, 600, (1280, 1024)),
    "stretched, off the middle": (300, 60, 700, 800, (1280, 1024)),
    "own size, in a corner": (480, 424, 800, 600, (1280, 1024)),
    "own size, in another corner": (0, 424, 800, 600, (1280, 1024)),
    "own size in a screen that the file does not tell": (240, 212, 800, 600, FRAME),
    "enlarged in a screen that the file does not tell": (240, 0, 1440, 1080, FRAME),
}


@pytest.mark.parametrize("seed", first_of(range(2)))
@pytest.mark.parametrize("label", PLACES)
def test_the_place_of_pictures_on_the_frame_is_named(label, seed):
    """What the line says is done: then the fixations lie where they were made."""
    x, y, width, height, frame = PLACES[label]
    scale = np.array([width, height]) / FRAME
    shown = drawn(lambda points, person, order: (points + 0.5) * scale + (x, y) - 0.5, frame, seed=seed)
    (line,) = content_suspicions(shown, BY_NAME, SIZES)
    numbers = re.search(r"place=\((.*?)\)", line)
    options = {"place": tuple(map(int, numbers[1].split(", ")))} if numbers else {"scale": 1}
    assert numbers or "own size" in line
    mended = [record.in_picture(FRAME, **options) for record in shown]
    for one, right in zip(mended, drawn(seed=seed), strict=True):
        assert np.abs(one.points - right.points).max() < 20  # of 800, from 960 fixations
    assert content_suspicions(mended, BY_NAME, SIZES) == []


def test_a_frame_between_those_that_are_tried_is_named():
    (line,) = content_suspicions(drawn(lambda points, person, order: (points + 0.5) * 1.28 - 0.5), BY_NAME, SIZES)
    width, height = map(int, re.search(r"a frame of about (\d+) × (\d+)", line).groups())
    assert abs(width - 1024) < 12
    assert abs(height - 768) < 9


@pytest.mark.parametrize("seed", first_of(range(20), count=5))
def test_nothing_is_suspicious_in_fixations_that_are_read_rightly(seed):
    assert content_suspicions(drawn(seed=seed), BY_NAME, SIZES) == []


def test_a_picture_that_is_letterboxed_is_read_so():
    assert content_suspicions(drawn(at(1.75, (1680, 1050)), (1680, 1050)), BY_NAME, SIZES) == []


@pytest.mark.parametrize("shift", [(40, 0), (-90, 55), (0, -64)])
def test_a_shift_is_known_within_ten_pixels(shift):
    (line,) = content_suspicions(drawn(lambda points, person, order: points + shift), BY_NAME, SIZES)
    found = [int(number) for number in line.partition("(")[2].partition(")")[0].split(", ")]
    assert np.abs(np.array(found) - shift).max() <= 10


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_a_drift_that_leaves_the_pictures_is_not_taken_for_wrong_names(seed):
    """Those in the last of 16 pictures lie 237 px from where they were made; blobs of people are 35 px wide."""
    drifted = drawn(lambda points, person, order: points + np.array([13, -9]) * order, seed=seed)
    (line,) = content_suspicions(drifted, BY_NAME, SIZES)
    assert "fixations in the second half of each person's pictures lie about" in line


def test_names_of_other_pictures_are_noticed():
    moved = NAMES[1:] + NAMES[:1]
    (line,) = content_suspicions(drawn(names=moved), BY_NAME, SIZES)
    assert "come 1 before theirs" in line
    mixed = list(np.random.default_rng(0).permutation(NAMES))
    (line,) = content_suspicions(drawn(names=mixed), BY_NAME, SIZES)
    assert "do not fit the pictures that they are named for" in line
    exchanged = [NAMES[9], *NAMES[1:9], NAMES[0], *NAMES[10:]]
    (line,) = content_suspicions(drawn(names=exchanged), BY_NAME, SIZES)
    assert line == f"the fixations of {NAMES[0]} and {NAMES[9]} fit each other's picture"


def test_what_is_common_to_all_pictures_tells_nothing():
    """Fixations in the middle of every picture fit none of them more than another."""
    y, x = np.mgrid[0:45, 0:60]
    middle = torch.from_numpy(np.exp(-((x - 29.5) ** 2 + (y - 22) ** 2) / 2 / 8**2))
    same = dict.fromkeys(NAMES, middle / middle.sum())
    rng = np.random.default_rng(0)
    records = [Fixations(name, "1", rng.normal([400, 300], 60, (20, 2)), FRAME) for name in NAMES]
    (line,) = content_suspicions(records, same, SIZES)
    assert "do not fit" in line
    assert "(0.00 bits" in line


def test_too_little_tells_nothing():
    upwards, _ = FAULTS["y ran upwards"]
    few = [record for record in drawn(upwards) if record.picture in NAMES[:4]]
    assert content_suspicions(few, BY_NAME, SIZES) == []
    assert content_suspicions(drawn(upwards)[:3], BY_NAME, SIZES) == []


def test_a_density_that_is_no_map_is_refused():
    with pytest.raises(InputError, match=r"densities: expected a map .* got \(2700,\)"):
        content_suspicions(drawn(), {name: density.flatten() for name, density in BY_NAME.items()}, SIZES)
