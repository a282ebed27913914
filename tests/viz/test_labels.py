"""Labels of boxes and numbers of fixations do not cover each other, nor areas that must stay free."""

from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semfov.viz.labels import place_labels, place_numbers, place_within

number = st.floats(0, 100, allow_nan=False)
boxes = st.lists(st.tuples(number, number, number, number), max_size=12)


def apart(a, b):
    return a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]


@given(boxes, st.tuples(number, number))
def test_labels_do_not_overlap(corners, point):
    framed = [(min(a, c), min(b, d), max(a, c), max(b, d)) for a, b, c, d in corners]
    gaze = (point[0], point[1], point[0] + 5, point[1] + 5)
    labels = place_labels(framed, [(20, 6)] * len(framed), (100, 100), [gaze])
    assert len(labels) == len(framed)
    assert all(apart(a, b) for a, b in combinations([gaze, *labels], 2))
    assert all(abs(x2 - x1 - 20) < 1e-9 and abs(y2 - y1 - 6) < 1e-9 for x1, y1, x2, y2 in labels)


def test_a_label_is_in_the_corner_of_its_box_and_in_the_frame():
    assert place_labels([(10, 20, 60, 70)], [(20, 6)], (100, 100)) == [(10, 20, 30, 26)]
    assert place_labels([(95, 98, 100, 100)], [(20, 6)], (100, 100)) == [(80, 94, 100, 100)]


@given(st.lists(st.tuples(number, number), min_size=1, max_size=14))
def test_placed_numbers_do_not_overlap_and_stay_in_the_frame(points):
    placed = place_numbers(points, [(9, 6)] * len(points), (100, 100), 30)
    assert len(placed) == len(points)
    assert placed[0] is not None
    kept = [box for box in placed if box is not None]
    assert all(apart(a, b) for a, b in combinations(kept, 2))
    for point, box in zip(points, placed, strict=True):
        if box is not None:
            assert box[0] >= 0
            assert box[1] >= 0
            assert box[2] <= 100 + 1e-9
            assert box[3] <= 100 + 1e-9
            others = [other for other in points if other != point]
            assert not any(box[0] < x < box[2] and box[1] < y < box[3] for x, y in others)


@given(st.lists(st.lists(st.tuples(number, number), min_size=1, max_size=4), max_size=9))
def test_labels_with_several_candidate_positions_do_not_overlap(candidates):
    placed = place_within(candidates, [(20, 6)] * len(candidates), (100, 100))
    assert all(apart(a, b) for a, b in combinations(placed, 2))
    if candidates:
        x, y = candidates[0][0]
        middle = (placed[0][0] + placed[0][2]) / 2, (placed[0][1] + placed[0][3]) / 2
        assert middle == pytest.approx((min(max(x, 10), 90), min(max(y, 3), 97)))
