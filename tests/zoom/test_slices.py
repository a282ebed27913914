"""Windows of a lattice, and slices in the order of what they promise."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from eval.zoom.orders import adaptive_slices
from semfov import InputError, WindowEye, ZoomAgent
from semfov.agents.episode import EpisodeLimits
from semfov.zoom.glances import LiveGlances
from semfov.zoom.lattice import CELLS, Lattice
from semfov.zoom.slices import ranked, raw, usual_slices
from tests.small import Coloured


@pytest.fixture
def agent():
    return ZoomAgent(WindowEye(Coloured()))


def picture(*squares):
    """Squares `(x, y, side, colour)` on grey, 1200 × 900 px."""
    pixels = np.random.default_rng(0).integers(95, 105, (900, 1200, 3), np.uint8)  # not blank
    for x, y, side, colour in squares:
        pixels[y : y + side, x : x + side] = {"red": (230, 25, 25), "green": (25, 230, 25)}[colour]
    return pixels


def test_slices_cover_the_picture(agent):
    lattice = agent.eye.open(picture()).lattice
    covered = np.zeros((900, 1200), bool)
    for window in usual_slices(lattice):
        x1, y1, x2, y2 = (int(edge) for edge in window.within)
        covered[y1:y2, x1:x2] = True
    assert covered.all()


@pytest.mark.parametrize("size", [(3840, 2160), (2160, 3840), (1600, 1201), (1819, 1000), (1818, 1000), (5003, 4999)])
def test_adaptive_slices_are_as_many_as_the_size_asks_and_cover_the_picture(size):
    windows = adaptive_slices(Lattice.over(size, (416, 416)))
    boxes = np.array([window.within for window in windows])
    columns, rows = (np.unique(boxes[:, axis]) for axis in (0, 1))
    across, down = (4, 3) if max(size) > 512 * (4 - 3 * 0.15) + 1 else (3, 2)
    assert len(columns) <= across
    assert len(rows) <= down
    assert len(columns) == across or len(rows) == down
    side = boxes[0, 2] - boxes[0, 0]
    for starts, length in ((columns, size[0]), (rows, size[1])):
        assert starts[0] == 0
        assert starts[-1] + side == max(length, side)
        assert (np.diff(starts) <= side * 0.85 + 1).all()


def test_windows_come_in_the_order_of_the_summed_scores(agent):
    """By a loop over the cells of the overview's hints."""
    glances = LiveGlances(agent.eye, agent.eye.open(picture((900, 600, 90, "green"), (100, 100, 60, "red"))))
    windows = usual_slices(glances.lattice)
    (overview,) = glances.see([path.window for path in agent.find_all(picture(), passes=1).glances])
    hints = overview.gist
    for targets in ([], [1], [2], [1, 2]):
        sums = []
        for window in windows:
            x1, y1, x2, y2 = (edge / hints.scale for edge in window.cells)
            total = 0.0
            for row in range(hints.scores.shape[0]):
                for column in range(hints.scores.shape[1]):
                    if int(x1) <= column < np.ceil(x2) and int(y1) <= row < np.ceil(y2):
                        scores = hints.scores[row, column]
                        total += float(max(scores[[t - 1 for t in targets]] if targets else scores))
            sums.append(total)
        assert [raw(overview, window, targets) for window in windows] == pytest.approx(sums, abs=1e-5)
        order, done, chosen = ranked(windows, targets), set(), []
        while choice := order([overview], done):
            done.add(choice[0][0])
            chosen.append(choice[0][1])
        assert chosen == pytest.approx(sorted(sums, reverse=True), abs=1e-5)


def test_searches_find_or_stay_undecided(agent):
    scene = picture((900, 600, 90, "green"))
    found = agent.search(scene, "green")
    assert found.decision.outcome == "found"
    assert found.ending == "detection"
    x1, y1, x2, y2 = found.decision.box.tolist()
    assert x1 < 945 < x2
    assert y1 < 645 < y2
    missing = agent.search(scene, "red")
    assert (missing.decision.outcome, missing.ending) == ("undecided", "windows")
    assert missing.passes == 1 + len(usual_slices(missing.lattice))


def test_limits_and_several_classes(agent):
    scene = picture((900, 600, 90, "green"), (100, 100, 60, "red"))
    both = agent.find_all(scene, ["red", "green"])
    assert sorted(both.objects.labels.tolist()) == [1, 2]
    assert both.targets == (1, 2)
    assert set(agent.find_all(scene, "red").objects.labels.tolist()) == {1}
    assert agent.find_all(scene, "red", passes=3).ending == "passes"
    seen = []
    stopped = agent.find_all(scene, on_look=lambda record: seen.append(record.passes) or len(seen) < 2)
    assert (stopped.ending, seen, stopped.passes) == ("stopped", [1, 2], 2)
    assert agent.search(picture(), "red", seconds=0).ending == "seconds"
    with pytest.raises(InputError, match="seconds"):
        EpisodeLimits(seconds=-1)
    assert torch.equal(both.candidates.boxes, agent.find_all(scene, [1, 2]).candidates.boxes)


sizes = st.tuples(st.integers(200, 9000), st.integers(200, 9000))


@given(sizes)
def test_windows_tile_the_picture(size):
    lattice = Lattice.over(size, (416, 416))
    wide, high = lattice.pitch
    assert lattice.columns * wide >= size[0] - 0.1 > (lattice.columns - 1) * wide - 0.2
    assert lattice.rows * high >= size[1] - 0.1 > (lattice.rows - 1) * high - 0.2
    for level in range(lattice.levels):
        assert lattice.window(level)[0] == pytest.approx(lattice.span(level) * wide)
    assert lattice.span(lattice.levels - 1) == CELLS
    whole = lattice.boxes(torch.tensor([0, 0, 0]))
    assert whole[2] >= size[0] - 0.5
    assert whole[3] >= size[1] - 0.5


@given(sizes)
def test_a_single_fixation_equals_its_row_among_all(size):
    lattice = Lattice.over(size, (416, 320))
    some = lattice.actions[:: max(len(lattice) // 20, 1)]
    fixations = [lattice.fixation(*action) for action in some.tolist()]
    assert torch.equal(torch.tensor(fixations), lattice.fixations(some))


def test_actions_are_numbered_and_fixations_are_centres_of_boxes():
    lattice = Lattice.over((2560, 1920), (416, 416))
    assert len(lattice.actions) == len(lattice) == 579
    for number in (0, 1, 153, 154, 578):
        assert lattice.number(*lattice.actions[number].tolist()) == number
    lattice = Lattice.over((3840, 2160), (416, 416))
    boxes, fixations = lattice.boxes(lattice.actions), lattice.fixations(lattice.actions)
    torch.testing.assert_close((boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5, fixations[:, :2])
    torch.testing.assert_close(416 / (boxes[:, 2] - boxes[:, 0]), fixations[:, 2])
