"""A scene seen one window at a time: the belief about it, and the value of a look."""

from itertools import pairwise

import pytest
import torch

from eval.head.run import _rests_on
from eval.head.scan import Scan
from semfov import Panorama, rollout
from semfov.belief.observers import LearnedMap, Target
from semfov.gaze.choice import Given
from semfov.head import ExploreGain, PerSecond, SearchGain, Speeds
from semfov.head.belief import SceneObserver
from semfov.head.episode import _HeadLooks, live, look_around
from semfov.head.gain import OUT
from semfov.head.views import Views
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
    evidence = models[0]
    pose = pose_ahead(views)
    cells = [33, 66, 52]
    belief = episode(views, eye, SceneObserver(Target(evidence), views), [pose * 100 + c for c in cells], 3)[-1]
    image = views.world.view(views.poses[pose])[0][None]
    inner, view = Target(evidence), eye.open(image)
    alone = inner.start(1, views.view_grid, image)
    for cell in cells:
        point = views.view_grid.centres[cell][None]
        alone = inner(alone, eye.look(view, point), point, views.view_grid, 3)
    shown, points = views.visible[pose], views.points[pose]
    for number in range(0, len(shown), 7):
        # Bilinear interpolation by hand, between the four cells around the point.
        at = (points[number] + 0.5) / torch.tensor([6.4, 4.8]) - 0.5
        at = at.clamp(0, 9)
        low = at.floor().clamp(max=8).long()
        share = at - low
        table = alone.present.view(10, 10)
        rows = [(1 - share[0]) * table[low[1] + k, low[0]] + share[0] * table[low[1] + k, low[0] + 1] for k in (0, 1)]
        expected = (1 - share[1]) * rows[0] + share[1] * rows[1]
        assert float(belief.probability(3)[0, shown[number]]) == pytest.approx(float(expected), abs=1e-5)


def test_cells_belong_to_the_view_with_the_closest_look(views, eye, models):
    pose = pose_ahead(views)
    other = int((views.poses - torch.tensor([30.0, 0, 60])).abs().sum(-1).argmin())
    actions = [pose * 100 + 50, other * 100 + 59, pose * 100 + 59]
    beliefs = episode(views, eye, SceneObserver(Target(models[0]), views), actions, 1)
    scene = len(views.world.scene)
    distances = torch.full((len(views.poses), scene), torch.inf)
    for count, (belief, action) in enumerate(zip(beliefs, actions, strict=True), 1):
        place, cell = divmod(action, 100)
        centre = views.view_grid.centres[cell]
        for number, point in zip(views.visible[place].tolist(), views.points[place], strict=True):
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
    belief = episode(views, eye, SceneObserver(Target(models[0]), views, prior=0.07), [pose * 100 + 55], 1)[0]
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
        belief = episode(views, eye, SceneObserver(Target(models[0]), views), [pose * 100 + 37], 3)[0]
        beliefs.append(belief.probability(3).view(30, 60))
    torch.testing.assert_close(beliefs[0].roll(30, -1), beliefs[1], atol=1e-4, rtol=0)


def test_search_gain_equals_brute_force(views, eye, models):
    pose = pose_ahead(views)
    belief = episode(views, eye, SceneObserver(Target(models[0]), views), [pose * 100 + 55, pose * 100 + 12], 2)[-1]
    gains = SearchGain(views, 0.7)(belief, pose, range(len(views)))
    chance, fovea = belief.probability(2)[0], 100 / 640
    for action in (pose * 100 + 55, pose * 100 + 89, 3, 1234):
        place, cell = divmod(action, 100)
        here = int(views.gaze_cell[action])
        value = 0.0 if belief.examined[0, here] else float(chance[here])
        points, inside = views.world.to_view(views.world.centres, views.poses[place])
        for x in inside.nonzero()[:, 0].tolist():
            distance = float(torch.linalg.vector_norm(points[x] - views.view_grid.centres[cell])) / 64
            closest = float(belief.closest[0, x])
            more = 1 / (1 + distance / fovea) - 1 / (1 + closest / fovea)
            value += 0.7 * float(views.world.area[x]) * float(chance[x]) * max(more, 0.0)
        assert float(gains[action]) == pytest.approx(value, rel=1e-4, abs=1e-5)


def test_gain_per_second_by_hand(views, eye, models):
    pose = pose_ahead(views)
    here = pose * 100 + 55
    belief = episode(views, eye, SceneObserver(Target(models[0]), views), [here], 2)[-1]
    gain, speeds = SearchGain(views), Speeds()
    visited = torch.zeros(1, len(views.grid), dtype=torch.bool)
    gains = gain(belief, pose, range(len(views)))
    every = range(len(views))
    torch.testing.assert_close(
        PerSecond(gain, speeds, here, every)(belief, visited)[0], gains / views.durations(here, speeds)
    )
    torch.testing.assert_close(PerSecond(gain, None, here, every)(belief, visited)[0], gains)
    tiling = PerSecond(gain, None, here)(belief, visited)[0].view(len(views), 100)
    side_by_side = [pose for row in views.tiling[0] for pose in row]
    torch.testing.assert_close(tiling[side_by_side], gains.view(len(views), 100)[side_by_side])
    assert (tiling > OUT).any(-1).nonzero()[:, 0].tolist() == sorted(side_by_side)


def test_the_head_stays_if_turning_is_expensive_and_turns_if_it_is_cheap(views, eye, models):
    """The eye has found nothing nearby: whether the head turns depends on its speed."""

    def turned(speeds):
        views.world.speeds = speeds
        observer, gain, start = SceneObserver(Target(models[0]), views), SearchGain(views), pose_ahead(views) * 100 + 55
        steps = look_around(
            views, live(eye, views), observer, lambda action: PerSecond(gain, speeds, action), start,
            target=1, passes=6,
        )  # fmt: skip
        poses = [step.action // 100 for step in steps]
        return sum(one != other for one, other in pairwise(poses))

    assert turned(Speeds(head=1e-3, acceleration=1e-3)) == 0
    assert turned(Speeds(head=1e6, acceleration=1e9)) == 5


def test_explore_gain_equals_brute_force(views, eye, models):
    model, pose = models[1], pose_ahead(views)
    belief = episode(views, eye, SceneObserver(LearnedMap(model), views), [pose * 100 + 55, pose * 100 + 11])[-1]
    gains = ExploreGain(views, model, 0.2)(belief, pose, [pose, 0])
    area, fovea = views.world.area, 100 / 640
    for action, allowed in ((pose * 100 + 3, True), (22, True), (3, False)):
        if not allowed:
            assert gains[action] == OUT
            continue
        place, cell = divmod(action, 100)
        value = 0.0
        for x, point in zip(views.visible[place].tolist(), views.points[place], strict=True):
            distance = torch.linalg.vector_norm(point - views.view_grid.centres[cell]) / 64
            if belief.owner[0, x] < 0:
                value += float(area[x]) * 0.2 / (1 + float(distance) / fovea)
            else:
                inputs = belief.class_probabilities()[:, x : x + 1], belief.closest[:, x : x + 1], belief.looks
                value += float(area[x] * model.gain(*inputs, distance[None, None, None])[0, 0, 0])
        assert float(gains[action]) == pytest.approx(value, rel=1e-3, abs=1e-4)


def test_a_scan_goes_through_its_poses_in_order(views, eye, models):
    observer, gain = SceneObserver(Target(models[0]), views), SearchGain(views)
    order = [5, 9, 30]
    steps = look_around(
        views, live(eye, views), observer, lambda action: Scan(gain, order, 2, action), 555, target=1, passes=8
    )
    assert [step.action // 100 for step in steps] == [5, 5, 9, 9, 30, 30, 5, 5]


def test_seconds_of_a_path_add_up_those_of_its_movements(views, eye, models):
    observer, gain, speeds = SceneObserver(Target(models[0]), views), SearchGain(views), Speeds()
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


def test_one_episode_at_a_time(views, models):
    observer = SceneObserver(Target(models[0]), views)
    refused("batch: expected 1, as a head has one episode at a time", observer.start, 2, views.grid, torch.zeros(1))
    refused("prior: expected a probability", SceneObserver, Target(models[0]), views, prior=1.5)
