"""The agent that turns its head, and the pictures of what it did."""

import math

import pytest
import torch

from semfov.agents import HeadAgent
from semfov.errors import InputError
from semfov.head import Flat, Panorama, Speeds
from semfov.head.episode import live
from semfov.sensor.sphere import Regions
from semfov.viz.head import animate_head, plot_head_path


@pytest.fixture
def agent(eye, models):
    return HeadAgent(eye, *models, speeds=Speeds(look=0.2)).eval()


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
    assert "blue, found, 1 looks" in repr(found)
    explored = agent.explore(world, passes=3)
    assert explored.target is None
    assert len(explored) == 3
    limited = agent.explore(world, seconds=1.0)
    assert limited.seconds[-1] <= 1.0


def test_detections_of_a_path_equal_those_of_the_eye(agent, panorama):
    world = Panorama(panorama)
    path = agent.search(world, "blue", passes=2, confirm=1.0)
    detect = live(agent.eye, path.views)
    for action, seen in zip(path.actions, path.detections, strict=True):
        assert torch.equal(detect(action).boxes, seen.boxes)


def test_boxes_of_a_flat_scene_lie_around_the_object(agent):
    image = torch.zeros(3, 480, 640)
    image[1, 200:240, 500:540] = 1
    path = agent.search(Flat(image, degree=4), "green", passes=4, confirm=1.0)
    seen = [path.places(look, 0.5)[0] for look in range(len(path))]
    boxes = torch.cat([places.boxes for places in seen])
    assert ((boxes[:, 0] > 470) & (boxes[:, 2] < 570) & (boxes[:, 1] > 170) & (boxes[:, 3] < 270)).all()


def test_a_head_that_zooms_uses_only_the_given_fields_of_view(agent, panorama, eye, models):
    wide = HeadAgent(eye, *models, fields=(40.0, 80.0))
    path = wide.explore(Panorama(panorama), passes=4)
    assert {float(path.views.poses[action // 100, 2]) for action in path.actions} <= {40.0, 80.0}


def test_paths_can_be_plotted_and_animated(agent, panorama, tmp_path):
    world = Panorama(panorama)
    for path in (agent.search(world, "blue", passes=3, confirm=1.0), agent.explore(world, passes=2)):
        figure = plot_head_path(path, panorama)
        assert figure.axes[0].get_title() == path.describe()
        film = animate_head(path, panorama)
        assert len(film) == len(path)
        frames = [frame.shape for frame in film.frames]
        assert len(set(frames)) == 1
    written = animate_head(path, panorama, tmp_path / "head.gif")
    assert written.stat().st_size > 1000
    with pytest.raises(InputError, match="looks: expected a number from 1 to 2"):
        plot_head_path(path, panorama, looks=3)


def test_arguments_are_checked(agent, panorama):
    world = Panorama(panorama)
    for arguments, message in (
        ({"target": "blu"}, "target"),
        ({"target": "blue", "passes": 0}, "passes"),
        ({"target": "blue", "start": 10**6}, "start"),
        ({"target": "blue", "confirm": 2.0}, "confirm"),
        ({"target": "blue", "foresight": -1.0}, "foresight"),
    ):
        with pytest.raises(InputError, match=message):
            agent.search(world, **arguments)
