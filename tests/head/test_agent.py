"""The agent that turns its head, and the pictures of what it did."""

import math

import pytest
import torch

from semfov import ActivePerception, Detections, Flat, HeadAgent, Panorama
from semfov.agents.head import _decide_look
from semfov.belief.observers import LearnedMap, Target
from semfov.belief.target_evidence import Thresholds
from semfov.gaze.policies import Policy
from semfov.head.belief import SceneBelief
from semfov.head.episode import HeadStep, live
from semfov.sensor.sphere import Regions
from tests.refusals import refused


@pytest.fixture
def agent(eye, models):
    return HeadAgent(eye, *models).eval()


def test_boxes_are_returned_as_directions_in_the_scene(agent, panorama):
    """An object seen across the seam of the panorama lies behind the viewer."""
    world = Panorama(panorama)
    views = agent.views(world)
    behind = int((views.poses - torch.tensor([-180.0, 0, 60])).abs().sum(-1).argmin())
    path = agent.search(world, "red", start=behind * 100 + 55, passes=1)
    places, labels, scores = path.places(0, 0.5)
    assert isinstance(places, Regions)
    assert len(places) > 0
    assert (labels == 1).all()
    assert (scores >= 0.5).all()
    middle = places.samples(3)[:, 4].mean(0)
    assert math.degrees(math.atan2(float(middle[0]), -float(middle[2]))) == pytest.approx(0, abs=6)
    boxes = places.panorama_boxes((360, 180))
    assert ((boxes[:, 0] > 340) | (boxes[:, 2] < 20) | (boxes[:, 2] > 360)).all()
    assert ((boxes[:, 1] > 70) & (boxes[:, 3] < 110)).all()


def test_searches_and_explorations_keep_to_their_limits(agent, panorama):
    world = Panorama(panorama)
    path = agent.search(world, "blue", passes=5, confirm=1.0)
    assert len(path) == len(path.seconds) == len(path.maps) == len(path.detections) == 5
    assert path.maps.shape[-1] == len(world.scene)
    assert not path.found
    assert path.gaze(0).shape == (3,)
    same = agent.search(world, "blue", passes=5, confirm=1.0)
    assert same.actions == path.actions
    found = agent.search(world, "blue", passes=5, confirm=0.0)
    assert found.found
    assert len(found) == 1
    assert repr(found).startswith("HeadPath: blue: found (")
    explored = agent.explore(world, passes=3)
    assert explored.target is None
    assert len(explored) == 3
    assert explored.detector == agent.eye.detector.name
    limited = agent.explore(world, duration=1.0)
    assert limited.seconds[-1] <= 1.0
    assert limited.why_it_ended() == "The next look would end after the time limit of the scene, 1 s (duration)."


def test_detections_of_a_path_equal_those_of_the_eye(agent, panorama):
    world = Panorama(panorama)
    path = agent.search(world, "blue", passes=2, confirm=1.0)
    detect = live(agent.eye, path.views)
    for action, seen in zip(path.actions, path.detections, strict=True):
        assert torch.equal(detect(action).boxes, seen.boxes)


def test_boxes_of_a_flat_scene_are_in_pixels_of_the_picture(agent):
    image = torch.zeros(3, 480, 640)
    image[1, 200:240, 500:540] = 1
    path = agent.search(Flat(image, degree=4), "green", passes=4, confirm=1.0)
    seen = [path.places(look, 0.5)[0] for look in range(len(path))]
    boxes = torch.cat([places.boxes for places in seen])
    assert ((boxes[:, 0] > 470) & (boxes[:, 2] < 570) & (boxes[:, 1] > 170) & (boxes[:, 3] < 270)).all()
    # It lies around the object, whatever view it was found in, and is the box of a confirmed object.
    image = torch.zeros(3, 480, 640)
    image[1, 200:240, 500:540] = 1
    first = agent.search(Flat(image, degree=4), "green", passes=1, confirm=1.0)
    assert first.page_data()["looks"][0]["turned"].startswith("pan 0°, tilt 0°, ")  # and not -0°
    seen = [n for n, gaze in enumerate(first.views.gaze) if (gaze - torch.tensor([519.5, 219.5])).abs().max() < 30]
    paths = [agent.search(Flat(image, degree=4), "green", passes=1, confirm=0.0, start=start) for start in seen]
    boxes = torch.stack([path.decision.box for path in paths if path.decision.box is not None])
    assert len({tuple(path.pose(0).tolist()) for path in paths}) > 1
    assert ((boxes[:, :2] > torch.tensor([470.0, 170])) & (boxes[:, 2:] < torch.tensor([570.0, 270]))).all()
    for path in paths:
        if path.decision.box is not None:
            assert path.objects.boxes[path.confirmed].tolist() == [path.decision.box.tolist()]


def test_a_head_that_zooms_uses_only_the_given_fields_of_view(agent, panorama):
    path = agent.explore(Panorama(panorama, fields=(40.0, 80.0)), passes=4)
    assert {float(path.views.poses[action // 100, 2]) for action in path.actions} <= {40.0, 80.0}


def test_arguments_are_checked(agent, panorama):
    world = Panorama(panorama)
    for arguments, message in (
        ({"target": "blu"}, "target"),
        ({"target": "blue", "passes": 0}, "passes"),
        ({"target": "blue", "start": 10**6}, "start"),
        ({"target": "blue", "confirm": 2.0}, "confirm"),
        ({"target": "blue", "foresight": -1.0}, "foresight"),
    ):
        refused(message, agent.search, world, **arguments)


def test_a_search_is_found_by_the_cell_at_the_gaze_and_says_so_in_its_decision(agent, panorama):
    world = Panorama(panorama)
    for target, confirm in (("blue", 0.0), ("blue", 0.2), ("red", 0.05), ("green", 1.0)):
        path = agent.search(world, target, passes=6, confirm=confirm)
        at_the_gaze = [float(path.maps[n, path.views.gaze_cell[a]]) for n, a in enumerate(path.actions)]
        assert [chance >= confirm for chance in at_the_gaze] == [False] * (len(path) - 1) + [path.found]
        assert path.found == (path.decision.outcome == "found")
        assert path.decision.probability == float(path.maps[-1].max())
        if path.found:
            assert path.decision.cell == int(path.views.gaze_cell[path.actions[-1]])
            assert path.decision.place == at_the_gaze[-1]
            assert path.ending == "decision"
        else:
            # Most of the scene was not seen yet.
            assert path.decision.outcome == "undecided"
            assert (path.decision.cell, path.decision.box) == (None, None)
    assert agent.explore(world, passes=1).decision is None


@pytest.mark.parametrize(
    ("examined", "unfixated", "outcome"),
    [
        (0.1, 0.03, "undecided"),  # a cell that was never seen is worth a look
        (0.1, 0.02, "absent"),
        (0.6, 0.02, "undecided"),  # probably there, but not where the eye looked
        (0.6, 0.65, "undecided"),
        (0.71, 0.9, "found"),
    ],
)
def test_without_a_find_the_rule_of_all_searches_decides(agent, panorama, examined, unfixated, outcome):
    views = agent.views(Panorama(panorama))
    cells, here = len(views.world.scene), int(views.gaze_cell[5])
    values = torch.full((1, cells, 2), unfixated)
    values[0, ~views.reachable] = 0.5 if outcome != "absent" else 0.03
    values[0, here] = examined
    fixated = torch.zeros(1, cells, dtype=torch.bool)
    fixated[0, here] = True
    nothing = torch.zeros(1, cells)
    belief = SceneBelief(values, nothing, nothing.long(), fixated, torch.ones(1), (None,) * len(views))
    step = HeadStep(5, 0.2, belief, Detections.empty(1, 4))
    decision = _decide_look(views, step, 1, Thresholds(0.7, 0.03, 0.7))
    assert decision.outcome == outcome
    # That of the place, not that of the scene.
    there = (here, pytest.approx(examined)) if outcome == "found" else (None, None)
    assert (decision.cell, decision.place) == there


def test_every_limit_ends_an_episode_and_a_search_has_a_decision_all_the_same(agent, panorama):
    world, seen = Panorama(panorama), []
    endings = {
        "passes": {"passes": 2},
        "seconds": {"seconds": 0.0},
        "duration": {"duration": 1.0},
        "stopped": {"on_look": lambda path: seen.append(len(path)) or len(path) < 3},
    }
    for ending, limit in endings.items():
        path = agent.search(world, "green", confirm=1.0, **limit)
        assert (path.ending, path.decision.outcome) == (ending, "undecided")
        explored = agent.explore(world, **limit)
        assert (explored.ending, explored.decision) == (ending, None)
    assert seen == [1, 2, 3] * 2
    assert agent.explore(world, worth=1e6).ending == "worth"
    whole = agent.explore(world, passes=10)
    gains = agent.explore(world, passes=10, worth=1e-6)
    assert gains.actions == whole.actions


def test_a_search_ends_when_no_cell_is_worth_a_look(agent, panorama):
    whole = agent.search(Panorama(panorama), "green", prior=0.3, confirm=1.0, passes=8)
    sure = [float(chances.max()) < 0.5 for chances in whole.maps]
    path = agent.search(Panorama(panorama), "green", prior=0.3, give_up=0.99, confirm=1.0, passes=8)
    assert [*sure, True].index(True) == len(path) - 1 if any(sure) else len(path) == 8
    assert path.decision.outcome == ("absent" if any(sure) else "undecided")


def test_the_agent_for_any_picture_finds_all_classes_with_a_head(agent, panorama):
    strategies = (
        (Target(agent.target_evidence), Policy("non-predictive")),
        (LearnedMap(agent.map_evidence), Policy("random")),
    )
    whole = ActivePerception(agent.eye, *strategies)
    path = whole.find_all(Panorama(panorama), passes=2)
    assert path.actions == agent.find_all(Panorama(panorama), passes=2).actions
    assert (path.target, path.targets) == (None, ())


@pytest.mark.slow
def test_finding_all_is_an_exploration_about_the_targets(agent, panorama):
    world = Panorama(panorama)
    everything = agent.find_all(world, passes=16)
    both = agent.find_all(world, ["red", "blue"], passes=16)
    blue = agent.find_all(world, "blue", passes=16)
    assert everything.actions == both.actions == blue.actions == agent.explore(world, passes=16).actions
    assert (both.target, both.targets, blue.target) == (None, (1, 3), 3)
    assert both.decision is None
    assert set(both.objects.labels.tolist()) == {1, 3}
    assert set(blue.objects.labels.tolist()) == {3}
    middles = (blue.objects.boxes[:, :2] + blue.objects.boxes[:, 2:]) / 2
    assert ((middles - torch.tensor([210.0, 90])).abs() < 15).all()
