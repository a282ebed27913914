"""A head that zooms: closer looks at places, beside the lattice of its widest field of view."""

import pytest
import torch

from semfov import Detections, Eye, Flat, Foveation, HeadAgent, Panorama
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.errors import InputError
from semfov.head import ExploreGain, PanTiltCamera, PerSecond, SearchGain, Speeds
from semfov.head.belief import SceneObserver
from semfov.head.closer import CloserLookOffers
from semfov.head.gain import OUT
from semfov.head.scenes import Sphere
from semfov.head.views import Views
from semfov.paths import HeadPath
from semfov.sensor.sphere import panorama_directions
from semfov.settings import ExploreSettings, SearchSettings
from tests.small import Coloured, rand

FIELDS = (4.0, 20.0, 60.0)


@pytest.fixture
def agent(models):
    """Its detector gives the box of a colour to the pixel."""
    return HeadAgent(Eye(Foveation(100.0, growth=2.0), Coloured(("red", "green", "blue"), (416, 312))), *models).eval()


@pytest.fixture
def speck():
    """A panorama with one small blue square, of 3 degrees, 20 degrees to the right and 10 degrees up."""
    image = torch.zeros(3, 720, 1440)
    image[2, 314:326, 794:806] = 1
    return image


def test_narrower_fields_add_no_poses_before_they_are_looked_through(speck):
    wide, zooming = (Views(Panorama(speck, fields=fields)) for fields in ((60.0,), (2.0, 60.0)))
    assert torch.equal(wide.poses, zooming.poses)
    assert torch.equal(wide.gaze_cell, zooming.gaze_cell)
    for one, other in zip(wide.shown, zooming.shown, strict=True):
        assert torch.equal(one.distances, other.distances)


def views_of(kind):
    if kind == "panorama":
        world = Panorama((720, 360), (64, 48), fields=FIELDS)
    elif kind == "flat":
        world = Flat((1280, 960), (64, 48), fields=FIELDS, degree=10)
    else:
        world = Sphere((720, 360), (64, 48), pan=(10.0, 300.0), tilt=(-20.0, 60.0), fields=FIELDS)
    return Views(world)


@pytest.mark.parametrize("kind", ["panorama", "flat", "arc"])
@pytest.mark.parametrize("field", FIELDS[:2])
def test_a_narrow_field_is_aimed_at_a_point_as_nearly_as_the_limits_allow(kind, field):
    """The action fixates the point to within a cell of the view, wherever the view can show it."""
    views = views_of(kind)
    world = views.world
    shown = 0
    for share in rand(60, 2):
        pixel = share * torch.tensor(world.picture) - 0.5
        point = pixel if kind == "flat" else panorama_directions(pixel[None], world.picture)[0]
        action = views.aim(point, field)
        assert action == views.aim(point, field)  # no new pose for the same place
        pose = views.poses[action // 100]
        assert float(pose[2]) == field
        for angle, (low, high) in zip(pose[:2].tolist(), (world.pan, world.tilt), strict=True):
            assert low - 1e-3 <= angle <= high + 1e-3
        seen, inside = world.to_view(point[None], pose)
        if bool(inside):
            shown += 1
            gap = (views.view_grid.centres[action % 100] - seen[0]).abs() / torch.tensor([6.4, 4.8])
            assert float(gap.max()) <= 0.51
    assert shown > 15
    assert len(views) > views.lattice
    assert len(views.gaze) == len(views.grid) == 100 * len(views)
    assert len(views.durations(0, Speeds())) == len(views.grid)


def offered(views, detections, belief, gain, target, action):
    closer = CloserLookOffers(gain, Speeds(), target)
    closer.see(action, detections)
    values = closer.values(belief, action)
    return closer, [int(number) for number in (values > OUT).nonzero()[:, 0]], values


def boxes_in_view(*sizes):
    """Detections of class 1 in a view of 416 × 312 px, at places apart from each other."""
    boxes = [(40.0 + 60 * n, 40.0 + 40 * n, 40.0 + 60 * n + size, 40.0 + 40 * n + size) for n, size in enumerate(sizes)]
    scores = torch.zeros(1, len(sizes), 4)
    scores[..., 1] = 0.3
    scores[..., 0] = 0.7
    return Detections(torch.tensor([boxes]), scores, torch.ones(1, len(sizes)).bool())


def test_a_box_is_shown_by_the_narrowest_field_that_has_room_for_it(speck, models):
    """By hand: three times the longer side; boxes that fill a third of the widest view get no closer look."""
    views = Views(Panorama(speck, fields=FIELDS))
    action, gain = views.ahead, SearchGain(views)
    belief = SceneObserver(SemanticSearch(models[0]), views, unseen_chance=0.03).start(1, views.grid, torch.zeros(1))
    sizes = (5.0, 12.0, 40.0, 200.0)
    detections = boxes_in_view(*sizes)
    _, actions, values = offered(views, detections, belief, gain, 1, action)
    fields = sorted(float(views.poses[number // 100, 2]) for number in actions)
    degrees = [size * max(1, 416 / 312) * 60 / 416 for size in sizes]
    expected = [min(field for field in FIELDS if field >= 3 * each) for each in degrees[:3]]
    assert fields == sorted(field for field in expected if field < 60)
    seconds = views.durations(action, Speeds())
    for number in actions:
        probability = float(belief.probability(1)[0, views.gaze_cell[number]])
        assert float(values[number]) == pytest.approx(probability / float(seconds[number]), rel=1e-5)
    # Boxes of other classes mark no place in a search.
    assert offered(views, detections, belief, gain, 2, action)[1] == []


def test_no_more_than_a_handful_is_offered_and_no_place_twice(speck, models):
    views = Views(Panorama(speck, fields=FIELDS))
    map_gain = ExploreGain(views)
    observer = SceneObserver(SemanticMap(models[1]), views)
    action = views.ahead
    point = views.grid.centres[action][None]
    detections = boxes_in_view(*[6.0] * 6)
    belief = observer(observer.start(1, views.grid, views.poses), detections, point, views.grid)
    closer, actions, _ = offered(views, detections, belief, map_gain, None, action)
    assert len(actions) == 4
    nothing = Detections.empty(1, 4)
    for number in actions:
        closer.see(number, nothing)
    again = closer.values(belief, action)
    assert {int(number) for number in (again > OUT).nonzero()[:, 0]}.isdisjoint(actions)
    assert 0 < int((again > OUT).sum()) <= 2


def test_offers_that_are_not_taken_leave_no_poses_behind(speck, models):
    """At each look there are other places; one offer in three is taken."""
    views = Views(Panorama(speck, fields=FIELDS))
    gain = SearchGain(views)
    observer = SceneObserver(SemanticSearch(models[0]), views, unseen_chance=0.1)
    closer = CloserLookOffers(gain, Speeds(), 1)
    nothing = Detections.empty(1, 4)
    point = views.grid.centres[views.ahead][None]
    belief = observer(observer.start(1, views.grid, views.poses), boxes_in_view(6.0), point, views.grid, target=1)
    taken = {}
    for number in range(9):
        action = (number % views.lattice) * 100 + 55
        closer.see(action, boxes_in_view(*[6.0 + number] * 6))
        offers = (closer.values(belief, action) > OUT).nonzero()[:, 0].tolist()
        if offers and number % 3 == 0:
            closer.see(offers[0], nothing)
            taken[offers[0]] = views.poses[offers[0] // 100].clone()
        assert len(views) <= views.lattice + len(taken) + 4
        assert len(views.gaze) == len(views.grid) == len(views.gaze_cell) == 100 * len(views)
    assert len(taken) > 1
    for action, pose in taken.items():
        assert torch.equal(views.poses[action // 100], pose)  # a pose that was looked from keeps its number


def test_a_pose_that_takes_a_free_number_is_as_one_that_is_added(speck):
    one, other = (Views(Panorama(speck, fields=FIELDS)) for _ in range(2))
    points = panorama_directions(torch.tensor([[300.0, 300.0], [900.0, 380.0]]), (1440, 720))
    number = one.aim(points[0], 20.0) // 100
    free = [number]
    action = one.aim(points[1], 4.0, free)
    expected = other.aim(points[1], 4.0)
    assert free == []
    assert action == expected
    assert len(one) == len(other)
    for name in ("poses", "gaze", "gaze_cell"):
        assert torch.equal(getattr(one, name), getattr(other, name))
    for name in ("cells", "points", "distances"):
        assert torch.equal(getattr(one.shown[number], name), getattr(other.shown[number], name))
    assert torch.equal(one.durations(0, Speeds()), other.durations(0, Speeds()))


@pytest.fixture
def closely(monkeypatch):
    """After the first look, only closer ones have a value."""
    monkeypatch.setattr(
        "semfov.agents.head.PerSecond", lambda gain, speeds, action: PerSecond(gain, speeds, action, poses=[])
    )


def towards_speck(views):
    """The action nearest to the speck, in the view nearest to it."""
    toward = torch.tensor([20.0, 10.0, 60.0])
    pose = int(views.world.turn(views.poses, toward.expand_as(views.poses)).argmin())
    point = views.world.to_scene(torch.tensor([views.world.size]) / 2 - 0.5, toward)
    pixel, _ = views.world.to_view(point, views.poses[pose])
    return pose * 100 + int(views.view_grid.cell_of(pixel))


@pytest.mark.usefixtures("closely")
@pytest.mark.parametrize("search", [True, False])
def test_a_small_object_is_looked_at_closely_and_the_record_is_stored(agent, speck, tmp_path, search):
    world = Panorama(speck, fields=FIELDS)
    start = towards_speck(agent.views(world))
    path = (
        agent.search(world, "blue", SearchSettings(start=start, confirm=1.0))
        if search
        else agent.explore(world, ExploreSettings(start=start))
    )
    assert [round(float(path.pose(look)[2])) for look in range(len(path))] == [60, 20]  # 4 degrees are too narrow
    assert path.pose(1)[:2].tolist() == pytest.approx((20.0, 10.0), abs=0.3)
    regions, labels, _ = path.places(1, 0.5)
    assert labels.tolist() == [3]
    assert tuple(world.angles_of(regions.samples(3)[:1, 4])[0].tolist()) == pytest.approx((20.0, 10.0), abs=0.1)
    path.save(tmp_path / "path.safetensors")
    loaded = HeadPath.load(tmp_path / "path.safetensors")
    for look in range(len(path)):
        assert torch.equal(loaded.pose(look), path.pose(look))
        assert torch.equal(loaded.gaze(look), path.gaze(look))
    for method in (path.pose, path.gaze, path.direction, path.places):
        with pytest.raises(InputError, match=r"look: expected .*, got 9"):
            method(9)
    assert torch.equal(loaded.objects.boxes, path.objects.boxes)
    # The closer look shows the object that the first one did; a search that leaves it open lists none.
    assert len(path.candidates) == 1
    assert len(path.objects) == int(not search)


@pytest.mark.usefixtures("closely")
def test_a_closer_look_changes_the_belief_at_its_place_alone(agent, speck):
    world = Panorama(speck, fields=(13.0, 60.0))
    path = agent.search(world, "blue", SearchSettings(start=towards_speck(agent.views(world)), confirm=1.0))
    assert [float(path.pose(look)[2]) for look in range(len(path))] == [60.0, 13.0]
    changed = (path.maps[1] != path.maps[0]).nonzero()[:, 0]
    angles = world.angles_of(world.centres[changed])
    assert 1 <= len(changed) <= 4  # cells of 6 degrees
    assert ((angles - torch.tensor([20.0, 10.0])).abs() < 7).all()


@pytest.mark.usefixtures("closely")
def test_a_camera_zooms_at_places_within_its_limits(agent, speck):
    class Zooming(PanTiltCamera):
        size, pan, tilt, fields = (416, 312), (-15.0, 15.0), (-5.0, 5.0), (20.0, 60.0)

        def __init__(self):
            self.panorama, self.asked = Panorama(speck, self.size), []

        def look_at(self, direction, field):
            self.asked.append((*direction, field))
            return self.panorama.look_at(direction, field)

    camera = Zooming()
    path = agent.explore(camera, ExploreSettings(start=towards_speck(agent.views(camera))))
    assert [tuple(path.pose(look).tolist()) for look in range(len(path))] == camera.asked
    assert camera.asked[1] == (15.0, 5.0, 20.0)  # the place is beyond both limits, and the fixation beside the middle
    assert path.direction(1) == pytest.approx((20.0, 10.0), abs=2)
