"""Labels of boxes do not cover each other, nor areas that must stay free."""

from itertools import combinations

from hypothesis import given
from hypothesis import strategies as st

from semfov.viz.labels import place_labels

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


def test_a_single_label_is_placed_in_the_corner_of_its_box():
    assert place_labels([(10, 20, 60, 70)], [(20, 6)], (100, 100)) == [(10, 20, 30, 26)]


def test_a_label_stays_in_the_frame():
    assert place_labels([(95, 98, 100, 100)], [(20, 6)], (100, 100)) == [(80, 94, 100, 100)]
