"""Objects of records: one set, merged from all looks, and confirmed by closer looks and the decision."""

import json
from dataclasses import replace
from math import isnan
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from semfov import Detections, Flat, Grid, Objects, Panorama
from semfov.cli.formats import Coco
from semfov.cli.outcome import _crops, _looks_text
from semfov.decision import CloseUp, Decision
from semfov.head.views import Views
from semfov.paths import HeadPath, WindowMoment, ZoomPath
from semfov.paths.head import head_looks
from semfov.paths.look import detections_in_words
from semfov.paths.windows import looks_at_windows
from semfov.report.episode import episode_data
from semfov.sensor.sphere import panorama_directions
from semfov.zoom import Lattice
from semfov.zoom.looks import Window, WindowLook
from tests import small

CLASSES = ("background", "cup", "cat")
LEFT, RIGHT = [10.0, 10, 30, 30], [50.0, 40, 70, 55]


def look(*found):
    """Detections of a look: box, class and score of each, the most confident first."""
    rows = sorted(found, key=lambda each: -each[2])
    scores = torch.zeros(1, len(rows), 3)
    for number, (_, label, score) in enumerate(rows):
        scores[0, number, 0], scores[0, number, label] = 1 - score, score
    boxes = torch.tensor([box for box, *_ in rows]).view(1, -1, 4)
    return Detections(boxes, scores, torch.ones(1, len(rows), dtype=torch.bool))


def scanpath(*looks, cells=(0, 11), **options):
    """Fixations on a grid of 4 × 3 cells over 80 × 60 px."""
    return small.scanpath(Grid(4, 3, (80, 60)), torch.tensor(cells), CLASSES, detections=looks, **options)


def shifted(box, by):
    return [n + by for n in box]


def test_the_nearest_fixation_and_the_closer_look_have_the_box():
    near_left, near_right = (
        look((LEFT, 1, 0.4), (shifted(RIGHT, 2), 1, 0.9)),
        look((shifted(LEFT, 2), 1, 0.8), (RIGHT, 1, 0.5)),
    )
    path = scanpath(near_left, near_right, target=None)
    assert path.objects.boxes.tolist() == [RIGHT, LEFT]
    assert path.objects.passes.tolist() == [1, 0]
    assert not path.confirmed.any()
    box = torch.tensor(shifted(LEFT, 1))
    sought = replace(path, target=1, closer=(CloseUp(1, 1, 0, box, 0.75, 0.9),))
    assert sought.objects.boxes.tolist() == [box.tolist(), RIGHT]
    assert sought.objects.scores.tolist() == [0.75, 0.5]
    assert sought.confirmed.tolist() == [True, False]
    assert sought.passes == 3
    refuted = replace(sought, closer=(CloseUp(1, 1, 0, box, 0.01, 0.2),))
    assert refuted.objects.boxes.tolist() == [RIGHT]


def test_a_confirmed_part_of_an_object_is_no_second_object():
    whole = [10.0, 10, 30, 70]
    part = [11.0, 12, 29, 30]  # inside the whole, with an IoU of 0.27
    other = [50.0, 40, 70, 55]
    first = torch.zeros(1).long()
    candidates = Objects(torch.tensor([whole]), torch.tensor([0.9]), first + 1, first)
    lattice = Lattice.over((640, 480), (416, 416))
    parts = {"looks": (), "score_threshold": 0.5, "unseen": (0.0, 0.0), "classes": CLASSES, "candidates": candidates}
    path = ZoomPath(lattice=lattice, target=1, decision=Decision("found", 0.97, 0.95), **parts)
    confirmed = replace(path, closer=(closer_look(part, 0.75), closer_look(whole, 0.95)))
    assert confirmed.objects.boxes.tolist() == [whole]
    assert confirmed.confirmed.tolist() == [True]
    # The score is a probability by all looks, whatever prior that of the place has.
    assert confirmed.objects.scores.tolist() == pytest.approx([0.9])
    elsewhere = replace(path, closer=(closer_look(other, 0.75),))
    assert elsewhere.objects.boxes.tolist() == [whole, other]


def closer_look(box, place):
    return CloseUp(None, 1, None, torch.tensor(box), place, place, 0)


@pytest.mark.parametrize("probability", [0.02, 0.3, 0.96])
def test_no_place_is_more_probable_than_the_picture(probability):
    first = torch.zeros(1).long()
    candidates = Objects(torch.tensor([[10.0, 10, 30, 70]]), torch.tensor([0.8]), first + 1, first)
    parts = {"looks": (), "unseen": (0.0, 0.0), "classes": CLASSES, "candidates": candidates}
    lattice = Lattice.over((640, 480), (416, 416))
    path = ZoomPath(lattice=lattice, target=1, decision=Decision("undecided", probability), **parts)
    assert path.place_probability == pytest.approx(min(probability, 0.8))


def test_what_was_not_sure_enough_for_the_decision_is_not_called_confirmed(monkeypatch):
    """Nothing is listed beside `undecided` or `absent`; at a frame of a stream it is, by its probability."""
    path = scanpath(
        look((LEFT, 1, 0.2)), look((LEFT, 1, 0.1)), target=1, decision=Decision("undecided", 0.9, None, None)
    )
    unsure = replace(path, closer=(CloseUp(0, 1, 0, torch.tensor(LEFT), 0.55, 0.9),))
    for outcome in ("undecided", "absent"):
        without = replace(unsure, decision=Decision(outcome, 0.9))
        assert (len(without.objects), len(without.confirmed), without.object_rows()) == (0, 0, [])
        assert len(without.candidates) == 1
    monkeypatch.setattr(type(unsure), "_goes_on", True)
    followed = replace(unsure)
    assert followed.objects.scores.tolist() == pytest.approx([0.55])
    assert followed.confirmed.tolist() == [False]
    assert len(replace(unsure, score_threshold=0.6).objects) == 0
    assert "(confirmed)" not in repr(unsure)


def test_an_undecided_search_names_its_best_place_and_whose_probability_it_has():
    """That of the most probable place, or without closer looks the best score; other searches name none."""
    looks = look((LEFT, 1, 0.2), (RIGHT, 2, 0.25)), look((LEFT, 1, 0.1), (RIGHT, 1, 0.12))
    path = scanpath(*looks, target=1, decision=Decision("undecided", 0.7), score_threshold=0.5)
    assert path.words.best_place == "best place: box 10,10–30,30, score 0.20"
    places = ((LEFT, 0.1, 0.9), (RIGHT, 0.3, 0.7))
    closer = tuple(CloseUp(0, 1, 0, torch.tensor(box), place, presence) for box, place, presence in places)
    path = replace(path, closer=closer)
    assert path.words.best_place == "best place: box 50,40–70,55, probability 0.30"
    assert "Best place: box 50,40–70,55, probability 0.30." in repr(path)
    box, probability = path.best_place
    assert (box.tolist(), probability) == (RIGHT, 0.3)
    assert path.to_dict()["summary"].endswith(" Best place: box 50,40–70,55, probability 0.30.")
    told = _looks_text(path).splitlines()
    assert [line.endswith(", as decided") for line in told if "closer look " in line][:2] == [False, True]
    options, source = SimpleNamespace(crops=Path("out")), SimpleNamespace(place=Path("in/a.png"))
    source.picture = lambda: torch.zeros(3, 60, 80)
    assert list(_crops(path, source, options)) == [str(Path("out/cup/in/a-best.jpg"))]
    values = path.to_dict()
    assert [values[name] for name in ("outcome", "x", "y", "x1", "y1", "x2", "y2")] == ["undecided", 60, 47.5, *RIGHT]
    assert (values["probability"], values["place_probability"]) == (0.7, 0.3)
    assert replace(path, closer=()).to_dict()["place_probability"] is None  # it has a score alone
    found = Decision("found", 0.9, 0, torch.tensor(LEFT), 0.8)
    for decision, number in ((found, 0.8), (replace(found, place=None), None), (Decision("absent", 0.09), None)):
        assert replace(path, decision=decision).to_dict()["place_probability"] == number
    assert replace(path, decision=Decision("absent", 0.1)).words.best_place == path.words.best_place
    for other in (None, Decision("absent", 0.09), Decision("found", 0.9, 0, torch.tensor(LEFT))):
        assert replace(path, decision=other).words.best_place == ""
    assert small.with_looks(replace(path, closer=()), detections=[look(), look()]).words.best_place == ""


def test_a_refuted_place_is_not_the_best_where_another_is_more_probable():
    """That of a candidate that was not looked at closely, if its score is a probability; the refuted one's is not."""
    seen = look((LEFT, 1, 0.9), (RIGHT, 1, 0.45))
    path = scanpath(seen, look(), target=1, decision=Decision("undecided", 0.7))
    shifted = torch.tensor([LEFT[0] + 2.0, *LEFT[1:]])  # the closer look has a box of its own
    refuted = replace(path, closer=(CloseUp(0, 1, 0, shifted, 0.001, 0.6),))
    assert refuted.place_probability == pytest.approx(0.001)
    by_probability = replace(refuted, unseen=(0.0, 0.0))
    box, probability = by_probability.best_place
    assert (box.tolist(), probability) == (RIGHT, pytest.approx(0.45))
    assert by_probability.place_probability == pytest.approx(0.45)


def test_looks_tell_the_target_first_and_count_detections_from_one_score_on():
    """However faint it is; what is fainter than 0.1 is told and counted nowhere else."""
    seen = look((LEFT, 2, 0.8), (RIGHT, 2, 0.5), (shifted(RIGHT, 4), 2, 0.3), (shifted(LEFT, 4), 1, 0.06))
    classes = list(CLASSES)
    assert detections_in_words(seen, classes, 2) == "cat 0.80, cat 0.50 and 1 more"
    assert detections_in_words(seen, classes, 2, target=1) == "cup 0.06 in 14,14–34,34, cat 0.80 and 2 more"
    assert detections_in_words(seen, classes, target=2) == "cat 0.80 in 10,10–30,30, cat 0.50, cat 0.30"
    assert detections_in_words(look(), classes, target=1) == detections_in_words(look((LEFT, 1, 0.09)), classes)
    path = scanpath(seen, look((LEFT, 1, 0.09)), target=1)
    assert [row["detections"] for row in path.rows()] == [3, 0]
    assert [row["seen"] for row in path.rows()] == ["cat", None]
    assert repr(path[0]).endswith(": 3 detections from score 0.1 on")
    fixations = episode_data(path, None, None, name="a")["fixations"]
    assert [len(each["detections"]) for each in fixations] == [3, 0]


def test_the_text_form_tells_where_the_objects_are():
    path = scanpath(look((LEFT, 1, 0.8)), look((RIGHT, 1, 0.1)), target=None)
    assert "cup 0.80 at (20, 20)" in repr(path)
    assert "looks at (column, row): " in repr(path)


def test_what_the_decision_found_is_among_the_objects():
    """With its own box, also where no detection has the score, or there is none at the place."""
    weak = scanpath(look((LEFT, 1, 0.2)), look((LEFT, 1, 0.1), (RIGHT, 1, 0.31)), target=1)
    assert weak.objects.boxes.tolist() == [RIGHT]
    for box in (shifted(LEFT, 1), [70.0, 0, 80, 9]):
        decided = replace(weak, decision=Decision("found", 0.8, 0, torch.tensor(box)))
        assert decided.objects.boxes.tolist() == [box, RIGHT]
        assert decided.confirmed.tolist() == [True, False]
        assert decided.objects.scores.tolist() == pytest.approx([0.8, 0.31])
        in_coco = Coco().added(decided, "a.jpg", None)["parts"]
        assert [(each["score"], each["confirmed"]) for each in in_coco] == [(0.8, True), (0.31, False)]
    absent = replace(weak, decision=Decision("absent", 0.1, None, None))
    assert absent.objects.boxes.tolist() == []


def test_objects_are_those_of_the_targets_from_the_threshold_on():
    path = scanpath(look((LEFT, 1, 0.4), (RIGHT, 2, 0.9)), look((shifted(LEFT, 40), 2, 0.06)), target=None)
    assert len(path.candidates) == 3
    assert path.objects.labels.tolist() == [2, 1]
    assert set(path.expected) == {"cat", "cup"}
    assert all(isnan(each) for each in (*path.expected.values(), *path.expected_error.values()))
    assert path.to_dict()["expected"] == path.to_dict()["expected_error"] == {"cat": None, "cup": None}
    assert replace(path, score_threshold=0.5).describe().endswith(": 1 object found")
    assert list(replace(path, target=1).expected) == ["cup"]
    assert replace(path, targets=(1, 2)).words.objects == "1 cup, 1 cat found"
    rows = path.object_rows()
    json.dumps(rows)
    assert rows[0]["class"] == "cat"
    assert [rows[0][name] for name in ("x1", "y1", "x2", "y2")] == RIGHT
    assert (rows[0]["x"], rows[0]["y"], rows[0]["look"], rows[0]["confirmed"]) == (60.0, 47.5, 1, False)
    frame = path.to_frame("objects")
    assert frame.to_dict("records") == rows


@pytest.mark.parametrize(
    ("chances", "unseen", "words"),
    [
        ([0.9, 0.9, 0.9, 0.2], (1.5, 0.25), "3 cups found; expect 4.4 ± 1.7 in all"),
        ([0.9, 0.9, 0.9, 0.3], (0.0, 0.0), "3 cups found; expect 3.0 ± 1.3 in all"),
        ([*[0.9] * 2, *[0.7] * 2], (8.0, 0.0), "4 cups found; expect 11 ± 4 in all"),  # 11.2 ± 3.53
        ([0.9, *[0.3] * 9], (0.0, 0.0), "1 cup found"),
        ([0.9, 0.1], (0.0, 0.0), "1 cup found; expect 1.0 ± 0.7 in all"),
        ([*[0.6] * 5, *[0.4] * 20], (0, 0), "5 cups found; expect 11 ± 5 in all"),  # 11 ± 4.8
        ([0.6, 0.6, 0.6, 0.6], (0.0, 0.0), "4 cups found; expect 2.4 ± 1.6 in all"),
        ([0.2], (0.0, 0.0), "No cup found"),
    ],
)
def test_the_number_in_all_is_the_expected_one_with_its_error(chances, unseen, words):
    """Where the detector shows faint candidates alone, a large picture has no number."""
    count = len(chances)
    found = Objects(torch.rand(count, 4), torch.tensor(chances), torch.ones(count).long(), torch.zeros(count).long())
    lattice, parts = Lattice.over((2560, 1920), (416, 416)), {"looks": (), "score_threshold": 0.5}
    path = ZoomPath(lattice=lattice, classes=CLASSES, target=1, candidates=found, unseen=unseen, **parts)
    assert path.describe() == f"{words}. 0 looks"
    values = path.to_dict()
    numbers = values["expected"]["cup"], values["expected_error"]["cup"]
    exact = pytest.approx((path.expected["cup"], path.expected_error["cup"]), rel=1e-3)
    assert numbers == (exact if "expect" in words else (None, None))


@pytest.mark.parametrize(
    ("chances", "targets", "words"),
    [
        ([(1, 0.6)] * 6, (1,), "6 cups found, some of them doubtful; expect 3.6 ± 1.7 in all"),
        ([(1, 0.9)] * 6, (1,), "6 cups found, some of them doubtful; expect 5.4 ± 1.0 in all"),
        ([(1, 0.95)] * 6, (1,), "6 cups found; expect 5.7 ± 0.8 in all"),
        (
            [*[(1, 0.6)] * 6, (2, 0.95)],
            (1, 2),
            "6 cups, 1 cat found, some of them doubtful; expect 3.6 ± 1.7 cups, 0.9 ± 0.3 cats in all",
        ),
        ([(1, 0.6)] * 6, (), "6 objects found"),
    ],
)
def test_a_stream_that_lists_more_than_it_expects_says_so(chances, targets, words):
    labels, scores = torch.tensor([label for label, _ in chances]), torch.tensor([chance for _, chance in chances])
    found = Objects(torch.rand(len(chances), 4), scores, labels, torch.zeros_like(labels))
    lattice = Lattice.over((2560, 1920), (416, 416))
    moment = WindowMoment(
        lattice=lattice, classes=CLASSES, target=None, targets=targets, looks=(), candidates=found, unseen=(0.0, 0.0),
        spread=0.0, score_threshold=0.35, number=0, next_window=Window.overview(lattice),
    )  # fmt: skip
    assert moment.describe() == words


def test_a_photograph_has_a_number_where_the_detector_hardly_reacts():
    """Of nothing none is expected, with an error of one; of faint candidates twice their sum."""
    lattice, empty = Lattice.over((640, 480), (416, 416)), torch.zeros(0).long()
    assert lattice.levels == 1
    nothing = Objects(torch.zeros(0, 4), torch.zeros(0), empty, empty)
    parts = {"looks": (), "score_threshold": 0.5, "unseen": (0.0, 0.0), "classes": CLASSES}
    path = ZoomPath(lattice=lattice, target=None, targets=(1, 2), candidates=nothing, **parts)
    assert path.expected == {"cup": 0, "cat": 0}
    assert path.expected_error == {"cup": 1, "cat": 1}
    assert path.describe() == "No cup, no cat found. 0 looks"
    faint = Objects(torch.rand(4, 4), torch.full((4,), 0.3), torch.ones(4).long(), torch.zeros(4).long())
    path = replace(path, candidates=faint)
    assert path.expected["cup"] == pytest.approx(2.4)
    assert path.expected_error["cup"] == pytest.approx((4 * 0.21 + 3.4**2) ** 0.5)
    assert path.describe() == "No cup, no cat found; expect at a guess 2.4 ± 3.5 cups in all. 0 looks"
    assert path.to_dict()["expected_guessed"] == {"cup": True, "cat": True}  # though no cat is expected
    listed = replace(path, candidates=replace(faint[:1], scores=torch.tensor([0.2])), score_threshold=0.1)
    assert listed.describe() == "1 cup, no cat found; expect at a guess 0.4 ± 1.5 cups in all. 0 looks"
    assert listed.expected_guessed == {"cup": True, "cat": True}
    assert replace(listed, unseen=None).expected_guessed == {"cup": None, "cat": None}  # no number is known
    assert isnan(replace(path, targets=()).expected["cup"])  # which nobody asked for
    fewer = replace(path, candidates=faint[:1])
    assert fewer.describe() == "No cup, no cat found; expect at a guess 0.6 ± 1.7 cups in all. 0 looks"


@pytest.mark.parametrize("probability", [0.2, 0.71])
def test_a_search_expects_no_fewer_than_the_probability_that_one_is_there(probability):
    """In words, files and rows; closer looks and the prior are known to the decision alone."""
    lattice = Lattice.over((640, 480), (416, 416))
    faint = Objects(torch.rand(1, 4), torch.tensor([0.2]), torch.ones(1).long(), torch.zeros(1).long())
    parts = {"looks": (), "score_threshold": 0.5, "unseen": (0.0, 0.0), "classes": CLASSES, "target": 1}
    decision = Decision("undecided", probability)
    path = ZoomPath(lattice=lattice, candidates=faint, decision=decision, **parts)
    assert replace(path, decision=None).expected["cup"] == pytest.approx(0.4)
    for numbers in (path.expected, path.to_dict()["expected"]):
        assert numbers["cup"] == pytest.approx(max(0.4, probability))
    assert path.expected_error == replace(path, decision=None).expected_error


@pytest.mark.parametrize(("clear", "given"), [(4, False), (5, True)])
def test_a_large_picture_in_which_others_are_clear_has_a_number_too(clear, given):
    """Of cups nothing is seen, among cats that are seen clearly; satellite pictures show next to nothing clearly."""
    lattice = Lattice.over((2560, 1920), (416, 416))
    cats = look(*((shifted(LEFT, 100 * number), 2, 0.75) for number in range(clear)))
    window_look = WindowLook(Window.overview(lattice), cats, torch.zeros(clear).bool(), torch.zeros(2), None)
    nothing = Objects(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0).long(), torch.zeros(0).long())
    parts = {"classes": CLASSES, "unseen": (0.0, 0.0), "score_threshold": 0.5, "target": 1}
    path = ZoomPath(lattice=lattice, looks=looks_at_windows([window_look], lattice, [0.0]), candidates=nothing, **parts)
    assert path.describe() == "No cup found. 1 look"
    number = path.expected["cup"], path.expected_error["cup"]
    assert number == (0, 1) if given else all(map(isnan, number))


def test_a_number_is_claimed_class_by_class():
    """Of cats the detector shows only faint candidates, so their number is withheld."""
    chances, labels = torch.tensor([0.9, 0.8, 0.3, 0.3, 0.2]), torch.tensor([1, 1, 2, 2, 2])
    found = Objects(torch.rand(5, 4), chances, labels, torch.zeros(5).long())
    lattice = Lattice.over((2560, 1920), (416, 416))
    parts = {"looks": (), "score_threshold": 0.5, "unseen": (0.5, 0.1), "target": None, "targets": (1, 2)}
    path = ZoomPath(lattice=lattice, classes=CLASSES, candidates=found, **parts)
    share = 1.7 / 2.5
    assert path.expected["cup"] == pytest.approx(1.7 + 0.5 * share)
    error = 2 * (0.09 + 0.16) + 0.1 * share + (0.3 * path.expected["cup"]) ** 2
    assert path.expected_error["cup"] == pytest.approx(error**0.5)
    assert replace(path, spread=0.0).expected_error["cup"] == pytest.approx((0.5 + 0.1 * share) ** 0.5)
    assert path.words.objects == "2 cups, no cat found; expect 2.0 ± 1.0 cups in all"
    every = replace(path, targets=())
    # Of all classes only those are counted of which something is listed.
    assert every.words.classes == "2 cups (2.0 ± 1.0 in all)"
    assert replace(every, score_threshold=0.1).words.classes == "3 cats, 2 cups (2.0 ± 1.0 in all)"
    assert replace(every, unseen=None).words.classes == "2 cups"
    assert isnan(path.expected["cat"])
    assert isnan(path.expected_error["cat"])
    values = path.to_dict()
    assert (values["expected"]["cat"], values["expected_error"]["cat"]) == (None, None)
    assert values["expected_guessed"] == {"cup": False, "cat": None}  # which no number can be
    json.dumps(values, allow_nan=False)


def test_looks_are_given_one_by_one():
    path = scanpath(look((LEFT, 1, 0.4)), look(), target=1, seconds=({"open": 0.5, "detect": 1.0}, {"detect": 0.25}))
    first, second = path
    assert first.fixation == tuple(path.fixations[0].tolist())
    assert first.region == (0, 0, 80, 60)
    assert (first.number, first.seconds, second.seconds, first.value) == (1, 1.5, 1.75, None)
    assert second.value == float(path.values[0, 11])
    assert torch.equal(first.detections.boxes, path.detections[0].boxes)


def head_path(world, actions, looks):
    views = Views(world)
    maps = torch.zeros(len(looks), len(world.scene))
    made = head_looks(views, actions, looks, maps, (0.5, 1.25)[: len(looks)])
    return HeadPath(views=views, looks=made, target=None, classes=CLASSES, maps=maps)


def test_boxes_of_a_head_are_in_pixels_of_the_picture_and_meet_across_the_seam():
    """Two views from either side of the seam of a panorama show one object on it."""
    world = Panorama((256, 128), (64, 48))
    views = Views(world)
    behind = panorama_directions(torch.tensor([[252.5, 63.5]]), world.picture)
    poses = [n for n, pose in enumerate(views.poses) if pose[1] == 0 and world.to_view(behind, pose)[1].all()]
    looks, actions = [], []
    for pose in poses[:2]:
        x, y = world.to_view(behind, views.poses[pose])[0][0].tolist()
        looks.append(look(([x - 6, y - 6, x + 7, y + 7], 1, 0.6)))
        actions.append(pose * views.cells + 55)
    path = head_path(world, tuple(actions), looks)
    assert len(path) == 2
    x1, y1, x2, y2 = path.objects.boxes[0].tolist()
    assert len(path.objects) == 1
    assert 0 <= x1 < 256 < x2
    assert (x1 + x2) / 2 == pytest.approx(253, abs=1.0)
    assert (y1 + y2) / 2 == pytest.approx(64, abs=0.5)
    assert [each.seconds for each in path] == [0.5, 1.25]
    assert path.looks[0].region[2] - path.looks[0].region[0] == pytest.approx(256 / 6, rel=0.05)


def test_boxes_of_a_flat_scene_are_scaled():
    world = Flat((640, 480), (40, 30), degree=8)
    path = head_path(world, (455,), [look(([10.0, 10, 20, 20], 1, 0.6))])
    x1, y1, x2, _ = path.looks[0].region
    scale = (x2 - x1) / 40
    assert path.objects.boxes[0].tolist() == pytest.approx(
        [x1 + 10 * scale, y1 + 10 * scale, x1 + 20 * scale, y1 + 20 * scale]
    )
    assert path.size == (640, 480)
