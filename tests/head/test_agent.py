"""The agent with a head, in scenes, in files and at cameras."""

import math

import numpy as np
import pytest
import torch
from PIL import Image
from torch.nn import functional as F

from examples.pan_tilt import SimulatedCamera
from semfov import ActivePerception, Detections, Eye, Flat, Foveation, HeadAgent, Panorama
from semfov.agents.head import _decide_look
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.data.examples import example
from semfov.gaze.policies import Policy
from semfov.head import CameraFrame, PanTiltCamera, PerSecond, SearchGain, Speeds, open_scene
from semfov.head.belief import SceneBelief, SceneObserver
from semfov.head.episode import HeadStep, live
from semfov.head.gain import OUT
from semfov.head.scenes import Sphere
from semfov.head.views import Views
from semfov.observation.thresholds import Thresholds
from semfov.paths import HeadPath
from semfov.sensor.sphere import Regions
from semfov.settings import ExploreSettings, FindSettings, SearchSettings
from tests.refusals import refused, unusable
from tests.small import Coloured, rand


@pytest.fixture
def agent(eye, models):
    return HeadAgent(eye, *models).eval()


def test_boxes_are_returned_as_directions_in_the_scene(agent, panorama):
    """An object seen across the seam of the panorama lies behind the viewer."""
    world = Panorama(panorama)
    views = agent.views(world)
    behind = int((views.poses - torch.tensor([-180.0, 0, 60])).abs().sum(-1).argmin())
    path = agent.search(world, "red", SearchSettings(start=behind * 100 + 55, passes=1))
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
    path = agent.search(world, "blue", SearchSettings(passes=5, confirm=1.0))
    assert len(path) == len(path.seconds) == len(path.maps) == len(path.detections) == 5
    assert path.maps.shape[-1] == len(world.scene)
    assert not path.found
    assert path.gaze(0).shape == (3,)
    same = agent.search(world, "blue", SearchSettings(passes=5, confirm=1.0))
    assert same.actions == path.actions
    found = agent.search(world, "blue", SearchSettings(passes=5, confirm=0.0))
    assert found.found
    assert len(found) == 1
    assert repr(found).startswith("HeadPath: blue: found (")
    explored = agent.explore(world, ExploreSettings(passes=3))
    assert explored.target is None
    assert len(explored) == 3
    assert explored.detector == agent.eye.detector.name
    limited = agent.explore(world, ExploreSettings(duration=1.0))
    assert limited.seconds[-1] <= 1.0
    assert limited.why_it_ended() == "The next look would end after the time limit of the scene, 1 s (duration)."


def test_a_prior_scales_all_cells_of_a_view_as_it_changes_the_presence(agent, panorama):
    """By the odds o that the view holds the target, P' / P = k (1 + o) / (1 + k o), with k the ratio of the priors."""
    chance = 0.03
    agent.searching.presence.offset.fill_(1.0)
    agent.searching.presence.slopes.copy_(torch.tensor([1.0, 0.0]))  # no cell is more probable than the view

    def look(prior, assumed):
        path = agent.search(Panorama(panorama), "green", SearchSettings(passes=1, prior=prior), chance=chance)
        assert (path.prior, path.assumed) == (None if prior == "fit" else prior, pytest.approx(assumed))
        return path.maps[0].double()

    usual = look("fit", 0.5)
    seen = usual != torch.tensor(chance, dtype=torch.float32)
    assert 0 < int(seen.sum()) < len(seen)
    odds = []
    for prior in (0.1, 0.4):
        k = prior / (1 - prior)
        rare = look(prior, prior)
        never = k * chance / (1 - chance)
        torch.testing.assert_close(rare[~seen], torch.full_like(rare[~seen], never / (1 + never)))
        ratio = rare[seen] / usual[seen]
        torch.testing.assert_close(ratio, ratio.mean().expand_as(ratio), rtol=1e-4, atol=0)
        odds.append(float((k - ratio.mean()) / (k * (ratio.mean() - 1))))
    assert odds[0] == pytest.approx(odds[1], rel=1e-3)


def test_the_probability_for_another_share_changes_as_a_search_with_it_or_more(agent, panorama):
    paths = {}
    for prior in (None, 0.1, 0.9):
        paths[prior] = agent.search(Panorama(panorama), "blue", SearchSettings(passes=2, confirm=1.0, prior=prior))
    usual = paths[None]
    assert (usual.prior, usual.assumed) == (None, 0.5)
    probability = usual.decision.probability
    assert usual.probability_at(0.5) == probability
    assert usual.probability_at(0.1) <= paths[0.1].decision.probability + 1e-6 < probability
    assert probability < paths[0.9].decision.probability <= usual.probability_at(0.9) + 1e-6


def test_detections_of_a_path_equal_those_of_the_eye(agent, panorama):
    world = Panorama(panorama)
    path = agent.search(world, "blue", SearchSettings(passes=2, confirm=1.0))
    detect = live(agent.eye, path.views)
    for action, seen in zip(path.actions, path.detections, strict=True):
        assert torch.equal(detect(action).boxes, seen.boxes)


def test_boxes_of_a_flat_scene_are_in_pixels_of_the_picture(agent):
    image = torch.zeros(3, 480, 640)
    image[1, 200:240, 500:540] = 1
    path = agent.search(Flat(image, degree=4), "green", SearchSettings(passes=4, confirm=1.0))
    seen = [path.places(look, 0.5)[0] for look in range(len(path))]
    boxes = torch.cat([places.boxes for places in seen])
    assert ((boxes[:, 0] > 470) & (boxes[:, 2] < 570) & (boxes[:, 1] > 170) & (boxes[:, 3] < 270)).all()
    # It lies around the object, whatever view it was found in, and is the box of a confirmed object.
    image = torch.zeros(3, 480, 640)
    image[1, 200:240, 500:540] = 1
    first = agent.search(Flat(image, degree=4), "green", SearchSettings(passes=1, confirm=1.0))
    assert first.page_data()["looks"][0]["turned"].startswith("pan 0°, tilt 0°, ")  # and not -0°
    seen = [n for n, gaze in enumerate(first.views.gaze) if (gaze - torch.tensor([519.5, 219.5])).abs().max() < 30]
    paths = [
        agent.search(Flat(image, degree=4), "green", SearchSettings(passes=1, confirm=0.0, start=start))
        for start in seen
    ]
    boxes = torch.stack([path.decision.box for path in paths if path.decision.box is not None])
    assert len({tuple(path.pose(0).tolist()) for path in paths}) > 1
    assert ((boxes[:, :2] > torch.tensor([470.0, 170])) & (boxes[:, 2:] < torch.tensor([570.0, 270]))).all()
    for path in paths:
        if path.decision.box is not None:
            assert path.objects.boxes[path.confirmed].tolist() == [path.decision.box.tolist()]


def test_a_head_that_zooms_uses_only_the_given_fields_of_view(agent, panorama):
    path = agent.explore(Panorama(panorama, fields=(40.0, 80.0)), ExploreSettings(passes=4))
    assert {float(path.views.poses[action // 100, 2]) for action in path.actions} <= {40.0, 80.0}


def test_arguments_are_checked(agent, panorama):
    world = Panorama(panorama)
    refused("target", agent.search, world, "blu")
    refused("start", agent.search, world, "blue", SearchSettings(start=10**6))
    refused("start: expected the number of an action", agent.explore, world, ExploreSettings(start=(5, 5)))
    refused("closer: expected none for .* a head that turns", agent.search, world, "blue", SearchSettings(closer=1))
    refused("shifts: expected none for .* a head that turns", agent.find_all, world, "blue", FindSettings(shifts=1))
    refused("foresight", agent.search, world, "blue", foresight=-1.0)


def test_a_search_is_found_by_the_cell_at_the_gaze_and_says_so_in_its_decision(agent, panorama):
    world = Panorama(panorama)
    for target, confirm in (("blue", 0.0), ("blue", 0.2), ("red", 0.05), ("green", 1.0)):
        path = agent.search(world, target, SearchSettings(passes=6, confirm=confirm))
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
    assert agent.explore(world, ExploreSettings(passes=1)).decision is None


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
    belief = SceneBelief(values, nothing, nothing.long(), fixated, torch.ones(1), {})
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
        path = agent.search(world, "green", SearchSettings(confirm=1.0, **limit))
        assert (path.ending, path.decision.outcome) == (ending, "undecided")
        explored = agent.explore(world, ExploreSettings(**limit))
        assert (explored.ending, explored.decision) == (ending, None)
    assert seen == [1, 2, 3] * 2
    assert agent.explore(world, ExploreSettings(min_gain=1e6)).ending == "min_gain"
    whole = agent.explore(world, ExploreSettings(passes=10))
    gains = agent.explore(world, ExploreSettings(passes=10, min_gain=1e-6))
    assert gains.actions == whole.actions


def test_a_search_ends_when_no_cell_is_worth_a_look(agent, panorama):
    whole = agent.search(Panorama(panorama), "green", SearchSettings(confirm=1.0, passes=8), chance=0.3)
    sure = [float(chances.max()) < 0.5 for chances in whole.maps]
    path = agent.search(Panorama(panorama), "green", SearchSettings(stop_below=0.99, confirm=1.0, passes=8), chance=0.3)
    assert [*sure, True].index(True) == len(path) - 1 if any(sure) else len(path) == 8
    assert path.decision.outcome == ("absent" if any(sure) else "undecided")


def test_the_agent_for_any_picture_finds_all_classes_with_a_head(agent, panorama):
    strategies = (
        (SemanticSearch(agent.searching), Policy("non-predictive")),
        (SemanticMap(agent.observation), Policy("random")),
    )
    whole = ActivePerception(agent.eye, *strategies)
    path = whole.find_all(Panorama(panorama), passes=2)
    assert path.actions == agent.find_all(Panorama(panorama), settings=FindSettings(passes=2)).actions
    assert (path.target, path.targets) == (None, ())


@pytest.mark.slow
def test_finding_all_is_an_exploration_about_the_targets(agent, panorama):
    world = Panorama(panorama)
    everything = agent.find_all(world, settings=FindSettings(passes=8))
    both = agent.find_all(world, ["red", "blue"], FindSettings(passes=8))
    blue = agent.find_all(world, "blue", FindSettings(passes=8))
    explored = agent.explore(world, ExploreSettings(passes=8))
    assert everything.actions == both.actions == blue.actions == explored.actions
    assert (both.target, both.targets, blue.target) == (None, (1, 3), 3)
    assert both.decision is None
    assert set(both.objects.labels.tolist()) == {1, 3}
    assert set(blue.objects.labels.tolist()) == {3}
    middles = (blue.objects.boxes[:, :2] + blue.objects.boxes[:, 2:]) / 2
    assert ((middles - torch.tensor([210.0, 90])).abs() < 15).all()


BLUE = (30.0, 0.0)
"""Pan and tilt of the middle of the blue square of `panorama`."""


@pytest.fixture
def exact(models):
    """An agent whose detector gives the box of a colour to the pixel."""
    return HeadAgent(Eye(Foveation(100.0, growth=2.0), Coloured(("red", "green", "blue"), (416, 312))), *models).eval()


def towards_blue(agent, camera):
    """The action in the middle of the view nearest to the blue square."""
    views = agent.views(camera)
    there = views.poses.new_tensor([*BLUE, 60.0]).expand_as(views.poses)
    return int(views.world.turn(views.poses, there).argmin()) * 100 + 55


class Own(PanTiltCamera):
    """The least that a camera needs; its frames are those of OpenCV."""

    size = (104, 78)

    def __init__(self, panorama):
        self.panorama, self.asked = Panorama(panorama, self.size), []

    def look_at(self, direction, field):
        self.asked.append(direction)
        return self.panorama.look_at(direction, field).mul(255).byte().permute(1, 2, 0).flip(-1).numpy()


def middle_of(path, look=-1):
    """Pan and tilt of the middle of the first object of a look."""
    regions, *_ = path.places(look, 0.5)
    return tuple(path.views.world.angles_of(regions.samples(3)[:1, 4])[0].tolist())


def test_a_camera_needs_a_size_and_a_way_to_look(exact, panorama):
    camera = Own(panorama)
    start = towards_blue(exact, camera)
    path = exact.search(camera, "blue", SearchSettings(confirm=0.0, start=start), color="bgr")
    assert path.found
    assert middle_of(path) == pytest.approx(BLUE, abs=1)
    explored = exact.explore(camera, ExploreSettings(passes=1, start=start))
    assert explored.detections[0].labels[0, 0] == 1  # blue is taken for red
    assert camera.asked == [(30.0, 0.0)] * 2


def test_every_look_at_a_camera_takes_a_new_frame(agent, panorama):
    camera = Own(panorama)
    path = agent.search(camera, "green", SearchSettings(passes=6, confirm=1.0))
    assert camera.asked == [tuple(path.pose(number)[:2].tolist()) for number in range(6)]


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_objects_are_where_they_are_though_the_camera_is_a_little_off(exact, panorama, noise):
    """A camera that reports its direction knows where an object is, whatever the error of its motors."""
    world, errors = Panorama(panorama), []
    for seed in range(6 if noise else 1):
        for reports in (True, False):
            camera = SimulatedCamera(world, noise=noise, delay=0.0, reports=reports, seed=seed)
            start = towards_blue(exact, camera)
            settings = SearchSettings(passes=1, confirm=1.0, start=start)
            found = middle_of(exact.search(camera, "blue", settings, color="bgr"))
            if reports:
                assert found == pytest.approx(BLUE, abs=0.5)
            else:
                errors.append(math.dist(found, BLUE))
    assert np.mean(errors) < 0.5 if noise == 0 else np.mean(errors) > noise / 2


def test_the_eye_fixates_the_same_direction_from_a_pose_nearby(agent, panorama):
    """The evidence of a cell does not depend on where the camera stopped."""
    beliefs = []
    for noise in (0.0, 1.0):
        camera = SimulatedCamera(Panorama(panorama), noise=noise, delay=0.0, seed=3)
        path = agent.search(camera, "blue", SearchSettings(passes=4, confirm=1.0, start=0), color="bgr")
        beliefs.append(path.maps[-1])
    difference = (beliefs[0] - beliefs[1]).abs()
    # Cells at the border of a box may change sides.
    assert float((difference > 0.06).float().mean()) < 0.01
    assert float(difference.max()) < 0.2


def test_frames_from_before_the_camera_arrived_are_not_used(agent, panorama):
    """Each frame that the agent uses is from the direction it asked for; late ones are asked for again."""
    camera = SimulatedCamera(Panorama(panorama), delay=0.5, noise=0.0)
    given, look_at = [], camera.look_at

    def watched(direction, field):
        given.append((direction, look_at(direction, field)))
        return given[-1][1]

    camera.look_at = watched
    path = agent.explore(camera, ExploreSettings(passes=12), color="bgr")
    assert path.turns >= 1
    late = [frame for direction, frame in given if frame.direction != pytest.approx(direction, abs=6)]
    assert late
    assert len(given) - len(late) == 12
    # The camera's own clock agrees with the time that its speeds predict, but for the way to the first direction.
    # A frame of the last few degrees of a movement counts already.
    ahead = float(camera.speeds.turn(torch.tensor(max(map(abs, given[0][0])))))
    predicted = path.seconds[-1] + ahead + camera.delay * (ahead > 0)
    turns = path.turns + 1
    assert predicted - turns * camera.delay <= camera.clock <= predicted + turns * camera.interval


def test_fewer_turns_are_made_when_settling_takes_long(agent, panorama):
    turns = []
    for settle in (0.0, 5.0):
        world = Panorama(panorama, speeds=Speeds(settle=settle))
        turns.append(agent.explore(world, ExploreSettings(passes=12, duration=math.inf)).turns)
    assert turns[1] < turns[0]


def test_turns_within_the_dead_zone_have_no_value(eye, models, panorama):
    views = Views(Panorama(panorama, speeds=Speeds(dead_zone=50.0)))
    belief = SceneObserver(SemanticSearch(models[0]), views).start(1, views.grid, torch.zeros(1))
    gain, here = SearchGain(views), views.ahead
    values = PerSecond(gain, views.world.speeds, here, range(len(views)))(
        belief, torch.zeros(1, len(views.grid)).bool()
    )
    made = (values.view(len(views), 100) > OUT).any(-1)
    angles = views.world.turn(views.poses[here // 100].expand_as(views.poses), views.poses)
    assert torch.equal(made, (angles < 0.1) | (angles >= 50))
    assert 1 < int(made.sum()) < len(views)


@pytest.mark.parametrize("limits", [((-170, 170), (-30, 60)), ((-40, 100), (0, 0)), ((10, 10), (-90, 20))])
@pytest.mark.parametrize("field", [35.0, 60.0])
def test_views_show_what_is_between_the_limits(limits, field):
    (left, right), (down, up) = limits
    world = Sphere((720, 360), (64, 48), pan=(left, right), tilt=(down, up))
    rows = world.poses(field)
    for pose in (pose for row in rows for pose in row):
        assert left - 1e-3 <= float(pose[0]) <= right + 1e-3
        assert down - 1e-3 <= float(pose[1]) <= up + 1e-3
    pan = torch.deg2rad(left + (right - left) * rand(400))
    tilt = torch.deg2rad(down + (up - down) * rand(401)[:400])
    across = tilt.cos()
    directions = torch.stack([across * pan.sin(), -tilt.sin(), across * pan.cos()], -1)
    tiling = [pose for row in rows[::2] for pose in row[::2]]
    seen = torch.stack([world.to_view(directions, pose)[1] for pose in tiling]).any(0)
    # The upper and lower edges of views bend away from a limit, which leaves out slivers there.
    assert float(seen.float().mean()) > 0.98
    assert seen[(tilt.rad2deg() < up - 10) & (tilt.rad2deg() > down + 10)].all()


def test_motors_turn_together_and_between_their_limits(panorama):
    class Stopped(Own):
        pan = (-170.0, 170.0)

    one, other = torch.tensor([-160.0, 10.0, 60.0]), torch.tensor([150.0, -20.0, 60.0])
    assert float(open_scene(Stopped(panorama)).turn(one, other)) == 310
    assert float(open_scene(Own(panorama)).turn(one, other)) == 50


def test_wrong_cameras_are_refused_with_the_remedy(agent, panorama):
    class Bare:
        size = (40, 30)

        def look_at(self, direction, field):
            return torch.zeros(3, 30, 40)

    refused(r"got Bare without pan, tilt, fields, speeds; derive it from", agent.explore, Bare())

    class Stuck(Own):
        def look_at(self, direction, field):
            return CameraFrame(super().look_at(direction, field), (30.0, 0.0))

    unusable(r"from pan 0\.0°.*got pan 30\.0°.*; wait in look_at", agent.explore, Stuck(panorama))

    class Large(Own):
        def look_at(self, direction, field):
            return super().look_at(direction, field)[:-1]

    refused(r"frame: expected 104 × 78 pixels, as `size` has it, got \(104, 77\)", agent.explore, Large(panorama))
    refused(r"camera: expected a camera, got the class Own; give Own\(…\)", agent.explore, Own)
    for fields in (60, (), (60.0, 30.0), (0.0, 60.0), (180.0,), ("60",)):
        for make in (Panorama, Flat):
            refused(r"fields: expected one or more angles .*, such as", make, panorama, fields=fields)
    refused("color: expected rgb for a Panorama", agent.explore, Panorama(panorama), color="bgr")
    refused("tilt: expected limits", open_scene, type("Upside", (Own,), {"tilt": (10.0, -10.0)})(panorama))


def test_a_picture_is_a_panorama_if_it_is_twice_as_wide_as_high(agent, panorama, tmp_path):
    pixels = panorama.mul(255).byte().permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(tmp_path / "around.png")
    whole = agent.explore(Panorama(panorama), ExploreSettings(passes=3))
    for picture, color in ((tmp_path / "around.png", "rgb"), (pixels[..., ::-1], "bgr"), (panorama, "rgb")):
        path = agent.explore(picture, ExploreSettings(passes=3), color=color)
        assert isinstance(path.views.world, Panorama)
        torch.testing.assert_close(path.maps, whole.maps)
    flat = open_scene(torch.rand(3, 300, 400))
    assert isinstance(flat, Flat)
    assert len(Views(flat)) >= 1  # the widest view fits


def test_the_record_of_a_camera_shows_what_it_saw_and_is_stored(agent, panorama, tmp_path):
    world = Panorama(panorama)
    camera = SimulatedCamera(world, noise=0.0, delay=0.0)
    path = agent.explore(camera, ExploreSettings(passes=8), color="bgr")
    small = path.image
    assert small.shape[-1] == 2 * small.shape[-2]
    points = path.views.world.pixels_of(torch.stack([path.gaze(look) for look in range(8)]))
    for x, y in points.tolist():
        column, row = int(x / path.size[0] * small.shape[-1]), int(y / path.size[1] * small.shape[-2])
        truth = panorama[:, int(y / path.size[1] * 180), int(x / path.size[0] * 360)]
        torch.testing.assert_close(small[:, row, column], truth, atol=0.3, rtol=0)
    assert float((small == 128 / 255).all(0).float().mean()) > 0.2  # not everything was seen
    path.save(tmp_path / "path.safetensors")
    loaded = HeadPath.load(tmp_path / "path.safetensors")
    assert loaded.views.world.tilt == (-30.0, 60.0)
    torch.testing.assert_close(loaded.gaze(-1), path.gaze(-1))
    assert len(loaded.objects) == len(path.objects)


def test_one_agent_takes_scenes_files_and_cameras(eye, models, panorama, tmp_path):
    """The kind of look follows from the picture; the record is that of the part of the agent that turns a head."""
    one = ActivePerception(
        eye, (SemanticSearch(models[0]), Policy("non-predictive")), (SemanticMap(models[1]), Policy("random"))
    ).eval()
    head = HeadAgent(eye, *models).eval()
    file = tmp_path / "around.png"
    Image.fromarray(panorama.mul(255).byte().permute(1, 2, 0).numpy()).save(file)
    limits = {"passes": 4, "duration": 20.0}
    expected = head.search(Panorama(panorama), "blue", SearchSettings(confirm=1.0, **limits))
    for picture, how in ((Panorama(panorama), "auto"), (file, "head"), (panorama, "head")):
        path = one.search(picture, "blue", how=how, confirm=1.0, **limits)
        assert isinstance(path, HeadPath)
        assert path.actions == expected.actions
        torch.testing.assert_close(path.maps, expected.maps)
    camera = Own(panorama)
    assert one.search(camera, "blue", color="bgr", confirm=1.0, **limits).actions[0] == head.views(camera).ahead
    assert one.find_all(camera, ["red", "blue"], color="bgr", **limits).targets == (1, 3)
    assert [look.number for look in one.explore(camera, color="bgr", min_gain=0.0, **limits)] == [1, 2, 3, 4]
    for wrong, message in (
        ({"picture": camera, "shifts": 3}, "shifts: expected none"),
        ({"picture": camera, "how": "windows"}, "how: expected 'head' or 'auto' for a scene"),
        ({"picture": panorama, "duration": 3.0}, "duration: expected none"),
    ):
        refused(message, one.explore, **wrong)


@pytest.mark.parametrize(
    ("limits", "unit"),
    [
        ((90, (-20, 20)), "got 90"),
        (((-3.15, 3.15), (-0.5, 1.57)), "radians"),
        (((-1, 1), (-1, 1)), "ONVIF"),
        (((0, 0), (-1, 0.5)), "ONVIF"),
        (((-1.57, 1.57), (-90, 90)), "radians"),
        (((-180, 180), (-0.5, 1.57)), "radians"),
        (((-1, 1), (-20, 90)), "ONVIF"),
        (((-170, 170), (-1.57, 1.57)), "radians"),
    ],
)
def test_limits_in_other_units_are_refused(limits, unit):
    class Narrow(PanTiltCamera):
        size, (pan, tilt) = (40, 30), limits

        def look_at(self, direction, field):
            return torch.rand(3, 30, 40)

    refused(f"(pan|tilt): expected .*degrees.*{unit}", open_scene, Narrow())


@pytest.mark.parametrize("fields", [(1.05,), (0.1, 1.05), (3,), (0.5,)])
def test_fields_of_view_in_other_units_are_refused(fields, panorama):
    """Whatever the scene. A narrow field beside a wide one is that of a camera that zooms."""
    camera = type("Narrow", (Own,), {"fields": fields})(panorama)
    for make in (lambda: Panorama(panorama, fields=fields), lambda: Flat(panorama, fields=fields)):
        refused("fields: expected degrees, got .*, which look like (radians|numbers from -1 to 1)", make)
    refused("fields: expected degrees", open_scene, camera)
    assert open_scene(type("Zooms", (Own,), {"fields": (*fields, 60.0)})(panorama)).fields == (*fields, 60.0)
    refused("reach: expected degrees", Panorama, panorama, reach=1.05)


def test_a_narrow_field_that_is_no_number_of_a_tensor_is_aimed():
    views = Views(Panorama(torch.rand(3, 64, 128), fields=(20.3, 60.1)))
    action = views.aim(torch.tensor([0.0, 0.0, 1.0]), 20.3)
    assert views.field_of(views.poses[action // views.cells]) == 20.3


@pytest.mark.slow
def test_a_target_is_not_absent_before_the_head_has_turned():
    """There is nothing in front of it, and a street with people behind."""
    scene = torch.full((3, 400, 800), 0.5)
    market = F.interpolate(example("market")[None], size=(200, 246), mode="bilinear")[0]
    scene[:, 100:300, 20:266] = market
    agent = HeadAgent.recommended("yolox-nano")
    first = agent.search(Panorama(scene), "person", SearchSettings(passes=1))
    assert first.decision.outcome != "absent"


def test_a_target_is_found_in_a_scene_with_fewer_cells_than_a_view(agent):
    """The cell of the view does not count the cells of the scene."""
    image = torch.zeros(3, 480, 640)
    image[1, 400:460, 560:620] = 1
    world = Flat(image)
    views = agent.views(world)
    assert len(world.scene) < views.cells
    last = max(range(len(views.gaze)), key=lambda n: float(views.gaze[n].sum()))
    path = agent.search(Flat(image), "green", SearchSettings(passes=1, confirm=0.0, start=last))
    assert path.found
    assert 0 <= path.decision.cell < len(world.scene)
