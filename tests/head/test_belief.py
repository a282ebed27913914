"""The world of a head and the belief about it: views, panoramas, speeds, and cells of several looks."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.nn import functional as F

from eval.head.run import _rests_on
from eval.head.scan import Scan
from semfov import Detections, EmbeddedScenes, Panorama, rollout
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.gaze.acquisition.accuracy import _CORRECTED
from semfov.gaze.choice import Given
from semfov.head import ExploreGain, Flat, Panoramas, PerSecond, SearchGain, Speeds
from semfov.head.belief import SceneObserver
from semfov.head.episode import _HeadLooks, live, look_around
from semfov.head.gain import OUT
from semfov.head.views import Views
from semfov.sensor import glimpse, perspective
from tests.refusals import refused


@pytest.fixture
def views(panorama):
    return Views(Panorama(panorama, (64, 48)))


def episode(views, eye, observer, actions, target=None):
    looks = _HeadLooks(views, live(eye, views), target)
    gain = SearchGain(views)
    acquire = (lambda _, cell: PerSecond(gain, None, int(cell))) if target else Scan(_NoGain(views), [0], 1, 0)
    start, given = torch.tensor(actions[:1]), Given(torch.tensor([actions]))
    return [step.belief for step in rollout(looks, observer, acquire, start, given, most=len(actions))]


class _NoGain(SearchGain):
    def forward(self, belief, here, poses):
        return torch.zeros(len(self.views.grid))


def pose_ahead(views):
    """Pose that looks ahead, at the horizon."""
    return int((views.poses - torch.tensor([0.0, 0, 60])).abs().sum(-1).argmin())


def test_belief_about_one_view_equals_that_of_an_eye_without_a_head(views, eye, models):
    """Cells of the scene have the values of the observer of a single picture, at their place in the view."""
    pose = pose_ahead(views)
    cells = [33, 66, 52]
    belief = episode(views, eye, SceneObserver(SemanticSearch(models[0]), views), [pose * 100 + c for c in cells], 3)[
        -1
    ]
    image = views.world.view(views.poses[pose])[0][None]
    inner, view = SemanticSearch(models[0]), eye.open(image)
    alone = inner.start(1, views.view_grid, image)
    for cell in cells:
        point = views.view_grid.centres[cell][None]
        alone = inner(alone, eye.look(view, point), point, views.view_grid, 3)
    shown, points = views.shown[pose].cells, views.shown[pose].points
    for number in range(0, len(shown), 7):
        # Bilinear interpolation by hand, between the four cells around the point.
        at = (points[number] + 0.5) / torch.tensor([6.4, 4.8]) - 0.5
        at = at.clamp(0, 9)
        low = at.floor().clamp(max=8).long()
        share = at - low
        table = alone.probability(3).view(10, 10)
        rows = [(1 - share[0]) * table[low[1] + k, low[0]] + share[0] * table[low[1] + k, low[0] + 1] for k in (0, 1)]
        expected = (1 - share[1]) * rows[0] + share[1] * rows[1]
        assert float(belief.probability(3)[0, shown[number]]) == pytest.approx(float(expected), abs=1e-5)


def test_cells_belong_to_the_view_with_the_closest_look(views, eye, models):
    pose = pose_ahead(views)
    other = int((views.poses - torch.tensor([30.0, 0, 60])).abs().sum(-1).argmin())
    actions = [pose * 100 + 50, other * 100 + 59, pose * 100 + 59]
    beliefs = episode(views, eye, SceneObserver(SemanticSearch(models[0]), views), actions, 1)
    scene = len(views.world.scene)
    distances = torch.full((len(views.poses), scene), torch.inf)
    for count, (belief, action) in enumerate(zip(beliefs, actions, strict=True), 1):
        place, cell = divmod(action, 100)
        centre = views.view_grid.centres[cell]
        for number, point in zip(views.shown[place].cells.tolist(), views.shown[place].points, strict=True):
            distance = torch.linalg.vector_norm(point - centre) / 64
            distances[place, number] = torch.minimum(distances[place, number], distance)
        nearest, owner = distances.amin(0), belief.owner[0]
        torch.testing.assert_close(belief.closest[0], nearest, atol=1e-5, rtol=0)
        assert torch.equal(owner < 0, nearest.isinf())
        # Two views may come equally near to a cell: then either of them may own it.
        seen = owner >= 0
        torch.testing.assert_close(distances[owner, torch.arange(scene)][seen], nearest[seen], atol=1e-5, rtol=0)
        assert int(belief.looks) == count
    assert beliefs[-1].examined.sum() == len({int(views.gaze_cell[action]) for action in actions})


def test_cells_that_were_never_seen_have_the_prior(views, eye, models):
    pose = pose_ahead(views)
    belief = episode(
        views, eye, SceneObserver(SemanticSearch(models[0]), views, unseen_chance=0.07), [pose * 100 + 55], 1
    )[0]
    unseen = belief.owner[0] < 0
    assert unseen.any()
    assert (belief.probability(1)[0, unseen] == 0.07).all()
    assert torch.equal(unseen, belief.closest[0].isinf())


def test_turning_the_world_turns_the_belief(eye, models, panorama):
    """The seam has no effect: a scene turned by half a circle gives the belief turned by half a circle."""
    beliefs = []
    for turned in (panorama, panorama.roll(180, -1)):
        views = Views(Panorama(turned, (64, 48)))
        yaw = 0.0 if turned is panorama else -180.0
        pose = int((views.poses - torch.tensor([yaw, 0, 60])).abs().sum(-1).argmin())
        belief = episode(views, eye, SceneObserver(SemanticSearch(models[0]), views), [pose * 100 + 37], 3)[0]
        beliefs.append(belief.probability(3).view(30, 60))
    torch.testing.assert_close(beliefs[0].roll(30, -1), beliefs[1], atol=1e-4, rtol=0)


def neighbours(views, cell):
    """A cell of a panorama and those around it, across the seam."""
    row, column = divmod(cell, 60)
    around = [(row + down, (column + right) % 60) for down in (-1, 0, 1) for right in (-1, 0, 1)]
    return [60 * y + x for y, x in around if 0 <= y < 30]


def test_search_gain_equals_brute_force(views, eye, models):
    pose = pose_ahead(views)
    belief = episode(
        views, eye, SceneObserver(SemanticSearch(models[0]), views), [pose * 100 + 55, pose * 100 + 12], 2
    )[-1]
    gains = SearchGain(views, 0.7)(belief, pose, range(len(views)))
    chance, fovea = belief.probability(2)[0], 100 / 640
    beside = int((views.gaze_cell == views.gaze_cell[pose * 100 + 55] + 1).nonzero()[0, 0])
    for action in (pose * 100 + 55, pose * 100 + 44, pose * 100 + 89, beside, 3, 1234):
        place, cell = divmod(action, 100)
        here = int(views.gaze_cell[action])
        fixated = [each for each in neighbours(views, here) if belief.examined[0, each]]
        value = 0.0 if any(chance[each] >= chance[here] for each in fixated) else float(chance[here])
        points, inside = views.world.to_view(views.world.centres, views.poses[place])
        for x in inside.nonzero()[:, 0].tolist():
            distance = float(torch.linalg.vector_norm(points[x] - views.view_grid.centres[cell])) / 64
            closest = float(belief.closest[0, x])
            more = 1 / (1 + distance / fovea) - 1 / (1 + closest / fovea)
            value += 0.7 * float(views.world.area[x]) * float(chance[x]) * max(more, 0.0)
        assert float(gains[action]) == pytest.approx(value, rel=1e-4, abs=1e-5)


def test_the_gaze_leaves_an_object_whose_most_probable_cell_was_fixated(views, models):
    """And goes on to a neighbour that is more probable than what was fixated; also across the seam."""
    gain = SearchGain(views, 0.0)
    start = SceneObserver(SemanticSearch(models[0]), views, unseen_chance=0.01).start(1, views.grid, torch.zeros(1))
    for cell in (60 * 15 + 30, 60 * 15):
        blob = neighbours(views, cell)
        values = torch.full_like(start.values, 0.01)
        values[0, blob] = 0.4
        values[0, blob[3]] = 0.6
        for fixated, remaining in ((cell, {blob[3]}), (blob[3], {blob[2], blob[5], blob[8]})):
            examined = torch.zeros_like(start.examined)
            examined[0, fixated] = True
            gains = gain(replace(start, values=values, examined=examined), 0, range(len(views)))
            found = {int(views.gaze_cell[action]) for action in (gains >= 0.4).nonzero()[:, 0]}
            assert found == remaining


def test_gain_per_second_by_hand(views, eye, models):
    pose = pose_ahead(views)
    here = pose * 100 + 55
    belief = episode(views, eye, SceneObserver(SemanticSearch(models[0]), views), [here], 2)[-1]
    gain, speeds = SearchGain(views), Speeds()
    visited = torch.zeros(1, len(views.grid), dtype=torch.bool)
    gains = gain(belief, pose, range(len(views)))
    every = range(len(views))
    torch.testing.assert_close(
        PerSecond(gain, speeds, here, every)(belief, visited)[0], gains / views.durations(here, speeds)
    )
    torch.testing.assert_close(PerSecond(gain, None, here, every)(belief, visited)[0], gains)
    tiling = PerSecond(gain, None, here)(belief, visited)[0].view(len(views), 100)
    side_by_side = [pose for row in views.tiling for pose in row]
    torch.testing.assert_close(tiling[side_by_side], gains.view(len(views), 100)[side_by_side])
    assert (tiling > OUT).any(-1).nonzero()[:, 0].tolist() == sorted(side_by_side)


def test_the_head_stays_if_turning_is_expensive_and_turns_if_it_is_cheap(views, eye, models):
    """The eye has found nothing nearby: whether the head turns depends on its speed."""

    def turned(speeds):
        views.world.speeds = speeds
        observer, gain, start = (
            SceneObserver(SemanticSearch(models[0]), views),
            SearchGain(views),
            pose_ahead(views) * 100 + 55,
        )
        steps = look_around(
            views, live(eye, views), observer, lambda action: PerSecond(gain, speeds, action), start,
            target=1, passes=6,
        )  # fmt: skip
        poses = [step.action // 100 for step in steps]
        return sum(one != other for one, other in pairwise(poses))

    assert turned(Speeds(head=1e-3, acceleration=1e-3)) == 0
    assert turned(Speeds(head=1e6, acceleration=1e9)) == 5


def test_explore_gain_equals_brute_force(views, eye, models):
    pose = pose_ahead(views)
    belief = episode(views, eye, SceneObserver(SemanticMap(models[1]), views), [pose * 100 + 55, pose * 100 + 11])[-1]
    gains = ExploreGain(views, 0.2)(belief, pose, [pose, 0])
    area, fovea = views.world.area, 100 / 640
    for action, allowed in ((pose * 100 + 3, True), (22, True), (3, False)):
        if not allowed:
            assert gains[action] == OUT
            continue
        place, cell = divmod(action, 100)
        value = 0.0
        for x, point in zip(views.shown[place].cells.tolist(), views.shown[place].points, strict=True):
            distance = torch.linalg.vector_norm(point - views.view_grid.centres[cell]) / 64
            if belief.owner[0, x] < 0:
                value += float(area[x]) * 0.2 / (1 + float(distance) / fovea)
            else:
                wrong = 1 - float(belief.class_probabilities()[0, x].max())
                now, before = (math.exp(-max(float(each) / fovea - 1, 0)) for each in (distance, belief.closest[0, x]))
                value += float(area[x]) * _CORRECTED * wrong * max(now - before, 0)
        assert float(gains[action]) == pytest.approx(value, rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("model", [0, 1])
def test_what_was_seen_fades_by_the_seconds_that_pass(views, eye, models, model):
    """By hand: log odds, or logarithms of all classes, of cells that the later looks do not show."""
    views.world.rate = 0.2
    speeds = views.world.speeds
    inner = SemanticSearch(models[0]) if model == 0 else SemanticMap(models[1])
    observer = SceneObserver(inner, views, unseen_chance=None if model else 0.03)
    order = [pose_ahead(views), views.tiling[1][5]]
    steps = look_around(
        views, live(eye, views), observer, lambda action: Scan(_NoGain(views), order, 1, action),
        order[0] * 100 + 55, target=None if model else 3, passes=2,
    )  # fmt: skip
    before, after = steps
    keep = math.exp(-0.2 * (after.seconds - before.seconds))
    assert after.seconds - before.seconds > speeds.look
    seen = before.belief.owner[0] == order[0]
    assert torch.equal(seen, after.belief.owner[0] == order[0])
    unseen = before.belief.values[0, before.belief.owner[0] < 0][0].double()
    old, new = before.belief.values[0, seen].double(), after.belief.values[0, seen].double()
    if model == 0:
        expected = (unseen.logit() * (1 - keep) + keep * old.logit()).sigmoid()
    else:
        expected = unseen ** (1 - keep) * old.clamp(min=1e-6) ** keep
        expected /= expected.sum(-1, keepdim=True)
    torch.testing.assert_close(new, expected, atol=1e-5, rtol=1e-3)
    assert (after.belief.closest[0, seen] > before.belief.closest[0, seen]).all()
    assert float((new - old).abs().max()) > 0.01


def test_a_still_head_that_forgets_believes_what_an_eye_without_a_head_does(views, eye, models):
    """Cells at the middles of the view's own, by the stream's formula of forgetting."""
    views.world.rate = 0.5
    pose, inner = pose_ahead(views), SemanticSearch(models[0])
    steps = look_around(
        views, live(eye, views), SceneObserver(inner, views), lambda action: Scan(_NoGain(views), [pose], 1, action),
        pose * 100 + 44, target=3, passes=4,
    )  # fmt: skip
    belief = inner.start(1, views.view_grid, views.poses)
    seconds = 0.0
    for step in steps:
        point = views.view_grid.centres[step.action % 100][None]
        look = inner.weigh(step.detections, point, views.view_grid, 3)
        keep = math.exp(-0.5 * (step.seconds - seconds)) if seconds else 1.0
        belief = inner.update(inner.fade(belief, look, keep, belief.visited), look)
        seconds = step.seconds
        got = step.belief.probability(3)[0, views.shown[pose].cells]
        torch.testing.assert_close(got, views.spread(belief.probability(3), pose)[0], atol=1e-5, rtol=0)


def test_a_scan_goes_through_its_poses_in_order(views, eye, models):
    observer, gain = SceneObserver(SemanticSearch(models[0]), views), SearchGain(views)
    order = [5, 9, 30]
    steps = look_around(
        views, live(eye, views), observer, lambda action: Scan(gain, order, 2, action), 555, target=1, passes=8
    )
    assert [step.action // 100 for step in steps] == [5, 5, 9, 9, 30, 30, 5, 5]


def test_seconds_of_a_path_add_up_those_of_its_movements(views, eye, models):
    observer, gain, speeds = SceneObserver(SemanticSearch(models[0]), views), SearchGain(views), Speeds()
    found = look_around(
        views, live(eye, views), observer, lambda action: PerSecond(gain, speeds, action), 555,
        target=1, duration=3.0,
    )  # fmt: skip
    steps = [*found]
    total = speeds.look
    for before, step in zip([None, *steps], steps, strict=False):
        if before is not None:
            total += float(views.durations(before.action, speeds)[step.action])
        assert step.seconds == pytest.approx(total, abs=1e-5)
    assert steps[-1].seconds <= 3.0
    assert len({step.action for step in steps}) == len(steps)


@pytest.mark.lab
def test_the_gaze_rests_on_the_boxes_that_its_cell_overlaps(views):
    """For boxes of the view itself, where cells and boxes are rectangles."""
    boxes = [(10.0, 10.0, 20.0, 20.0), (30.2, 30.3, 30.6, 30.7), (50.0, 0.0, 64.0, 48.0)]
    pose, hits = pose_ahead(views), 0
    places = views.world.places(torch.tensor(boxes), views.poses[pose])
    for cell in range(100):
        x1, y1, x2, y2 = views.view_grid.edges[cell].tolist()
        found = _rests_on(views, pose * 100 + cell, places).tolist()
        for rests, (left, top, right, bottom) in zip(found, boxes, strict=True):
            gap = min(right - x1, x2 - left, bottom - y1, y2 - top)
            if abs(gap) > 0.3:  # where they almost touch, rounding decides
                assert rests == (gap > 0)
            hits += rests
    assert hits > 20


@pytest.fixture(params=["panorama", "flat"])
def world(request):
    torch.manual_seed(0)
    if request.param == "panorama":
        return Panorama(torch.rand(3, 180, 360), (64, 48))
    return Flat(torch.rand(3, 480, 640), (64, 48), degree=4)


def test_points_and_boxes_are_converted_to_the_scene_and_back(world):
    points = torch.rand(40, 2) * 40
    for row in world.poses(60.0):
        there = world.to_scene(points, row[0])
        back, inside = world.to_view(there, row[0])
        torch.testing.assert_close(back, points, atol=2e-3, rtol=0)
        assert inside.all()
    boxes = torch.tensor([[10.0, 5, 30, 25], [40, 20, 64, 48]])
    pose = world.poses(60.0)[1][1]
    places = world.places(boxes, pose)
    for number, (x1, y1, x2, y2) in enumerate(boxes.tolist()):
        inside = torch.tensor([[x1 + 0.5, y1 + 0.5], [x2 - 1.5, y2 - 1.5], [(x1 + x2) / 2, (y1 + y2) / 2]])
        outside = torch.tensor([[x1 - 2, y1], [x1, y1 - 2]])
        assert places.contain(world.to_scene(inside, pose))[number].all()
        assert not places.contain(world.to_scene(outside, pose))[number].any()
    back, _ = world.to_view(places.samples(2).flatten(0, 1), pose)
    corners = back.view(2, 4, 2)[:, [0, 3]].flatten(1) + 0.5
    torch.testing.assert_close(corners, boxes, atol=5e-2, rtol=0)


def test_every_second_pose_of_every_second_row_tiles_the_scene(world):
    """All of a flat scene, and of a panorama the part that the head can reach."""
    rows = world.poses(60.0)
    tiling = [pose for row in rows[::2] for pose in row[::2]]
    seen = torch.stack([world.to_view(world.centres, pose)[1] for pose in tiling]).any(0)
    if isinstance(world, Flat):
        assert seen.all()
    else:
        latitude = torch.rad2deg(torch.asin(-world.centres[:, 1]))
        assert seen[latitude.abs() < 60].all()


def test_cells_contain_their_centres_and_panoramas_are_twice_as_wide_as_high(world):
    assert torch.equal(world.scene.cell_of(world.pixels_of(world.centres)), torch.arange(len(world.scene)))
    torch.testing.assert_close(world.pixels_of(world.centres), world.scene.centres, atol=1e-3, rtol=0)
    assert float(world.area.mean()) == pytest.approx(1)
    with pytest.warns(UserWarning, match="twice as wide as high, got 64 × 48 px"):
        Panorama(torch.rand(3, 48, 64), (32, 24))
    Panorama(torch.rand(3, 48, 98), (32, 24))


def test_views_are_perspectives_of_panoramas_and_glimpses_of_flat_scenes():
    torch.manual_seed(0)
    image = torch.rand(3, 90, 180)
    pose = torch.tensor([33.0, 20.0, 60.0])
    expected = perspective(image[None], pose[None], (32, 24))[0]
    world = Panorama(image, (32, 24))
    torch.testing.assert_close(world.view(pose)[0], expected.clamp(0, 1))
    torch.testing.assert_close(world.look_at((33.0, 20.0), 60.0), expected.clamp(0, 1))
    # Without the border pixels, where a glimpse also uses pixels from outside the window.
    torch.manual_seed(0)
    image = torch.rand(3, 120, 160).mul(255).round() / 255
    view = Flat(image, (32, 24), degree=5).look_at((-4.0, 2.0), 16.0)  # 20 px to the left, 10 px up
    expected = glimpse(image[None], torch.tensor([[20.0, 20, 100, 80]]), (32, 24))[0]
    torch.testing.assert_close(view[:, 1:-1, 1:-1], expected[:, 1:-1, 1:-1], atol=1e-5, rtol=0)


def test_angles_of_eye_and_head():
    """Closed forms: poses of a ring differ by equal steps, and the angle from side to side is the field of view."""
    panorama = Panorama(torch.rand(3, 90, 180), (64, 48))
    ring = torch.stack(panorama.poses(60.0)[2])
    assert float(ring[0, 1]) == 0
    torch.testing.assert_close(panorama.turn(ring[0].expand_as(ring), ring)[:4], torch.tensor([0.0, 30, 60, 90]))
    sides = torch.tensor([[-0.5, 23.5], [63.5, 23.5]])
    assert float(panorama.shift(sides[0], sides[1], 60.0)) == pytest.approx(60, abs=1e-3)
    flat = Flat(torch.rand(3, 480, 640), (64, 48), degree=4)
    assert float(flat.shift(sides[0], sides[1], 60.0)) == pytest.approx(60, abs=1e-3)
    assert float(flat.turn(torch.tensor([0.0, 0, 60]), torch.tensor([7.5, 10, 60]))) == pytest.approx(12.5)


def test_a_head_that_turns_to_the_angles_of_a_point_has_it_in_the_middle_of_its_view(world):
    points = world.centres[torch.randint(len(world.centres), (30,), generator=torch.Generator().manual_seed(1))]
    middle = torch.tensor(world.size) / 2 - 0.5
    for point, (pan, tilt) in zip(points, world.angles_of(points).tolist(), strict=True):
        pose = torch.tensor([pan, tilt, 20.0])
        if isinstance(world, Flat) and not (abs(pan) < 70 and abs(tilt) < 52):
            continue  # the window would not fit
        seen, inside = world.to_view(point[None], pose)
        assert inside.all()
        torch.testing.assert_close(seen[0], middle, atol=0.6 if isinstance(world, Flat) else 1e-2, rtol=0)


def test_actions_are_cells_of_a_strip(world):
    views = Views(world)
    assert len(views.grid) == len(views.poses) * 100
    centres = views.grid.centres
    for action in (0, 137, 555, len(views.grid) - 1):
        pose = action // 100
        point = centres[action] - torch.tensor([0, pose * world.size[1]])
        torch.testing.assert_close(point, views.view_grid.centres[action % 100], atol=1e-3, rtol=0)
        expected = world.to_scene(point[None], views.poses[pose])[0]
        torch.testing.assert_close(views.gaze[action], expected, atol=1e-3, rtol=1e-4)


def test_durations_equal_brute_force(world):
    from semfov.head import Speeds

    views, speeds = Views(world, (40.0, 80.0) if isinstance(world, Panorama) else (60.0,)), Speeds()
    here = 7 * 100 + 33
    durations = views.durations(here, speeds)
    generator = torch.Generator().manual_seed(0)
    for action in torch.randint(len(views.grid), (20,), generator=generator).tolist():
        one, other = views.poses[7], views.poses[action // 100]
        points = views.view_grid.centres[[33, action % 100]]
        eye = world.shift(points[0], points[1], float(other[2]))
        expected = speeds.duration(eye, world.turn(one, other), (other[2] / one[2]).log2())
        assert float(durations[action]) == pytest.approx(float(expected), abs=1e-4)
    assert float(durations[here]) == pytest.approx(speeds.look)


def test_windows_beyond_a_picture_and_several_episodes_are_refused(views, models):
    flat = Flat(torch.rand(3, 48, 64), (32, 24), degree=2)
    refused("pose: expected a window inside 64 × 48 pixels", flat.look_at, (-16.0, 0.0), 20.0)
    refused("field: expected a window inside the picture", flat.poses, 60.0)
    refused("fields: expected", Views, flat, (30.0, 20.0))
    observer = SceneObserver(SemanticSearch(models[0]), views)
    refused("batch: expected 1, as a head has one episode at a time", observer.start, 2, views.grid, torch.zeros(1))
    refused("unseen_chance: expected a probability", SceneObserver, SemanticSearch(models[0]), views, unseen_chance=1.5)
    nothing = Detections.empty(1, 3)
    refused("target: expected a class to search for, got None", observer.weigh, nothing, torch.zeros(1, 2), views.grid)


CLASSES = ("person", "dog", "boat")


@pytest.fixture(scope="module")
def scenes():
    return EmbeddedScenes(CLASSES, count=5)


@pytest.mark.slow
def test_a_camera_that_looks_at_a_photograph_sees_it_undistorted(scenes):
    panoramas = Panoramas(scenes, width=1024, count=1)
    panorama = panoramas[0].image[None]
    for patch in panoramas.patches(0):
        seen = perspective(panorama, torch.tensor([patch.pose]), (160, 120))[0]
        # Its slot is of 640 × 480 px, of which this view has a quarter.
        left, top, right, bottom = (round(edge / 4) for edge in patch.box)
        seen = seen[:, top:bottom, left:right]
        image, size = scenes[patch.scene].image[None], (bottom - top, right - left)
        photograph = F.interpolate(image, size, mode="bilinear", antialias=True)[0]
        inner = slice(3, -3)
        apart = (seen - photograph)[:, inner, inner].abs()
        assert apart.mean() < 0.03  # of photographs with hard contrasts
        # Moved by two pixels, it differs more.
        for dims in (-1, -2):
            for shift in (-2, 2):
                assert (seen - photograph.roll(shift, dims))[:, inner, inner].abs().mean() > apart.mean()
        # Another photograph differs much more.
        other = scenes[(patch.scene + 1) % 5].image[None]
        other = F.interpolate(other, size, mode="bilinear", antialias=True)[0]
        assert (seen - other)[:, inner, inner].abs().mean() > 3 * apart.mean()


def test_regions_match_the_boxes_of_the_photographs(scenes):
    """A camera that looks at a patch sees each object where the photograph has it."""
    panoramas = Panoramas(scenes, width=512, count=2, seed=4)
    regions, labels = panoramas.regions(1), panoramas.annotation(1).labels
    start = 0
    from semfov.sensor.sphere import Camera

    for patch in panoramas.patches(1):
        annotation = scenes.annotation(patch.scene)
        own = regions[torch.arange(start, start + len(annotation.boxes))]
        assert torch.equal(labels[start : start + len(own)], annotation.labels)
        start += len(own)
        corners = own.samples(2)
        camera = Camera(torch.tensor(patch.pose), (640, 480))
        points, _ = camera.points(corners.flatten(0, 1))
        seen = points.view(-1, 4, 2) + 0.5
        x1, y1, x2, y2 = patch.box
        scale = torch.tensor([(x2 - x1) / annotation.size[0], (y2 - y1) / annotation.size[1]]).repeat(2)
        expected = annotation.boxes * scale + torch.tensor([x1, y1]).repeat(2)
        torch.testing.assert_close(torch.cat([seen[:, 0], seen[:, 3]], -1), expected, atol=1e-2, rtol=0)
    assert start == len(regions)


def test_photographs_of_a_panorama_do_not_overlap_are_used_once_and_their_boxes_lie_in_it(scenes):
    from semfov.sensor.sphere import Camera, Regions

    patches = Panoramas(scenes, width=256, count=1).patches(0)
    slots = Regions(torch.tensor([p.box for p in patches]), Camera(torch.tensor([p.pose for p in patches]), (640, 480)))
    held = slots.contain(slots.samples(21).flatten(0, 1)).view(len(patches), len(patches), -1)
    for number in range(len(patches)):
        others = torch.cat([held[number, :number], held[number, number + 1 :]])
        assert not others.any()
    panoramas = Panoramas(scenes, width=1024, count=1)
    annotation = panoramas.annotation(0)
    assert annotation.size == (1024, 512)
    assert (annotation.boxes[:, 2:] > annotation.boxes[:, :2]).all()
    assert (annotation.boxes[:, 0] >= 0).all()
    assert (annotation.boxes[:, 0] <= 1024).all()
    assert panoramas.targets(0) == sorted(set(annotation.labels.tolist()))
    one, same, other = (Panoramas(scenes, rings=((0.0, 5),), width=256, count=3, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one[2].image, same[2].image)
    assert one.fingerprint == same.fingerprint != other.fingerprint
    assert one.digest(2) == same.digest(2) != one.digest(1)
    assert one.patches(0) != other.patches(0)
    assert sorted(patch.scene for patch in one.patches(0)) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"width": 101}, "width"), ({"slot": 180.0}, "slot"), ({"rings": ((95.0, 1),)}, "rings"), ({"count": 0}, "count")],
)
def test_invalid_settings_are_refused(scenes, settings, message):
    refused(message, Panoramas, scenes, **settings)


@given(st.floats(0.5, 180), st.floats(20, 400), st.floats(50, 2000))
def test_the_head_turns_as_a_motor_with_bounded_speed_and_acceleration(angle, speed, acceleration):
    found = float(Speeds(head=speed, acceleration=acceleration).turn(torch.tensor(angle, dtype=torch.float64)))
    # Step by step: accelerate as long as there is room to brake.
    step, time, done, pace = found / 20_000, 0.0, 0.0, 0.0
    while done < angle and time < 2 * found:
        braking = pace**2 / (2 * acceleration) >= angle - done
        pace = max(pace - acceleration * step, 1e-9) if braking else min(pace + acceleration * step, speed)
        done, time = done + pace * step, time + step
        if braking and pace <= acceleration * step:
            break
    assert time == pytest.approx(found, rel=0.01)


def test_durations_of_movements_follow_the_main_sequence_and_settling():
    speeds = Speeds()
    eye, head, zoom = torch.tensor(20.0), torch.tensor(90.0), torch.tensor(-3.0)
    none = torch.tensor(0.0)
    assert float(speeds.duration(none, none, none)) == speeds.look
    assert float(speeds.duration(eye, head, none)) == pytest.approx(speeds.look + float(speeds.turn(head)))
    assert float(speeds.duration(eye, none, none)) == pytest.approx(speeds.look + float(speeds.saccade(eye)))
    assert float(speeds.duration(eye, head, zoom)) == pytest.approx(speeds.look + 3 * speeds.zoom)
    # 21 ms plus 2.2 ms per degree (Carpenter, 1988); a saccade of 0° takes no time.
    found = Speeds().saccade(torch.tensor([0.0, 5.0, 10.0, 20.0]))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.032, 0.043, 0.065]))
    plain, slow, none = Speeds(), Speeds(settle=0.4), torch.tensor(0.0)
    eye, head, zoom = torch.tensor(20.0), torch.tensor(90.0), torch.tensor(-1.0)
    for moved, later in (((eye, none, none), 0.0), ((eye, head, none), 0.4), ((none, none, zoom), 0.4)):
        assert float(slow.duration(*moved) - plain.duration(*moved)) == pytest.approx(later)


def test_turns_within_the_dead_zone_are_not_made(models):
    views = Views(Flat(torch.rand(3, 480, 640), (40, 30), degree=8))
    belief = SceneObserver(SemanticSearch(models[0]), views).start(1, views.grid, torch.zeros(1))
    every = range(len(views))
    for dead_zone in (0.0, 15.0, 25.0):
        gain = PerSecond(SearchGain(views), Speeds(dead_zone=dead_zone), 55, every)
        made = (gain(belief, torch.zeros(1, len(views.grid), dtype=torch.bool))[0] > OUT).unflatten(0, (-1, 100)).any(1)
        turns = (views.poses[:, :2] - views.poses[0, :2]).norm(dim=-1)
        assert made.tolist() == [turn == 0 or turn >= dead_zone for turn in turns.tolist()]


@pytest.mark.parametrize("settings", [{"look": 0.0}, {"head": -1.0}, {"eye": float("nan")}, {"acceleration": 0.0}])
def test_invalid_speeds_are_refused(settings):
    refused(next(iter(settings)), Speeds, **settings)
