"""Live perception of a camera or a video: beliefs persist and fade, and equal those of a search if nothing changes."""

import math
from dataclasses import FrozenInstanceError
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch.nn import functional as F

import semfov
from semfov import ActivePerception, Eye, FovealObservationModel, Foveation, Grid, InputError
from semfov.belief.observers import Semantic, SemanticMap, SemanticSearch
from semfov.data.examples import example
from semfov.data.sources import open_stream
from semfov.episode import Forgetting
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.settings import StreamSettings
from tests.films import encode
from tests.refusals import refused
from tests.small import Coloured, tensors

SIZE = (160, 120)


def scene(x, y=8, size=24):
    """A green square on grey."""
    picture = torch.full((3, 120, 160), 0.4)
    picture[:, y : y + size, max(x, 0) : max(x + size, 0)] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]
    return picture


def searching(thresholds=None):
    odds = torch.tensor([[1.0, 1], [0.1, 0.3], [0.15, 0.2]])
    presence = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.tensor([0.7, 0.9]), thresholds)
    model = FovealObservationModel.identity(["red", "green"], [0.2], miss_odds=odds, refutation=0.6, presence=presence)
    return SemanticSearch(model)


def observation():
    return FovealObservationModel.identity(["red", "green"], [0.2])


def observers():
    return {
        "semantic": Semantic(3),
        "closest": Semantic(3, memory="closest"),
        "search": searching(),
        "map": SemanticMap(observation()),
    }


def agent_with(observer, policy=None):
    eye = Eye(Foveation(40.0), Coloured(), reference=160.0)
    policy = policy or Policy("non-predictive")
    mapper = Semantic(3) if isinstance(observer, SemanticSearch) else observer
    return ActivePerception(eye, (observer, policy), (mapper, Policy("random")), grid=(8, 6)).eval()


@pytest.mark.parametrize("name", observers())
def test_beliefs_fade_by_the_rate_and_after_a_long_gap_a_frame_is_as_the_first(name):
    """A camera that comes back after hours has told nothing that still counts."""
    agent, image = agent_with(observers()[name]), scene(100, 80)
    live = agent.live("green", seed=5, how="fovea", start=3)
    live.step(torch.full((3, 120, 160), 0.4))
    after = live.step(image, passed=1e9)
    fresh = agent.live("green", seed=5, how="fovea", start=after.cell).step(image)
    torch.testing.assert_close(after.probability, fresh.probability, rtol=1e-4, atol=1e-6)
    observer, grid = observers()[name], Grid(8, 6, SIZE)
    eye, like = agent_with(observer).eye, torch.zeros(1)
    fixation = grid.centres[[20]]
    seen = eye(scene(100, 80), fixation)
    look = observer.weigh(seen, fixation, grid, 2)
    belief = observer.update(observer.start(1, grid, like), look)
    visited = torch.zeros(1, 48, dtype=torch.bool)
    for before, after in zip(tensors(belief), tensors(observer.fade(belief, look, 1.0, visited)), strict=True):
        assert torch.equal(before, after)
    # The remaining evidence hardly changes the belief after the next look.
    fresh = observer.update(observer.start(1, grid, like), look)
    again = observer.update(observer.fade(belief, look, 1e-7, visited), look)
    torch.testing.assert_close(again.probability(2), fresh.probability(2), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", observers())
def test_live_search_of_a_constant_image_at_rate_zero_equals_a_search(name, one_thread):
    """Cells, posterior, detections and visited cells are equal to the bit."""
    agent, image = agent_with(observers()[name]), scene(100, 80)
    live = agent.live("green", rate=0, seed=5)
    with torch.inference_mode():
        searched = agent.search(image, "green", seed=5, shifts=11, boxes=torch.tensor([[-9.0, -9, -1, -1]]))
    moments = [live.step(image) for _ in range(12)]
    assert [moment.cell for moment in moments] == searched.cells.tolist()
    for moment, posterior, seen in zip(moments, searched.posterior, searched.detections, strict=True):
        assert torch.equal(moment.probability, posterior)
        assert torch.equal(moment.seen.boxes, seen.boxes)
        assert torch.equal(moment.visited.nonzero()[:, 0], searched.cells[: moment.number + 1].sort().values)
    assert set(moments[0].seconds[0]) == {"open", "foveate", "detect", "weigh", "update belief", "choose"}


def test_a_prior_changes_the_fovea_in_a_search_and_in_a_stream_by_the_odds(one_thread):
    agent, image = agent_with(searching(Thresholds(1.0, 0.0, 0.5))), scene(100, 80)
    live = agent.live("green", rate=0, start=3, seed=5, how="fovea", prior=0.2)
    with torch.inference_mode():
        usual = agent.search(image, "green", start=3, shifts=4, seed=5, how="fovea", prior="fit", stop_below=0.0)
        rare = agent.search(image, "green", start=3, shifts=4, seed=5, how="fovea", prior=0.2, stop_below=0.0)
        several = agent.search(image, ["red", "green"], shifts=1, how="fovea")
    moments = [live.step(image) for _ in range(5)]
    assert (usual.prior, usual.assumed) == (None, pytest.approx(0.9))
    odds = usual.presence / (1 - usual.presence) * (0.2 / 0.8) * (0.1 / 0.9)
    assert torch.equal(rare.cells, usual.cells)
    torch.testing.assert_close(rare.presence, odds / (1 + odds), rtol=1e-4, atol=1e-6)
    assert usual.probability_at(0.2) == pytest.approx(rare.decision.probability, rel=1e-4)
    for number, moment in enumerate(moments):
        assert (moment.prior, moment.assumed) == (0.2, 0.2)
        assert moment.decision.probability == pytest.approx(float(rare.presence[number]), rel=1e-5)
    assert several.assumed is None


def test_live_exploration_of_a_constant_image_at_rate_zero_equals_an_exploration(one_thread):
    agent = agent_with(Semantic(3))
    agent = ActivePerception(
        agent.eye,
        (Semantic(3), Policy("non-predictive")),
        (SemanticMap(observation()), Policy("closer-look", fovea=0.2)),
        grid=(8, 6),
    ).eval()
    live, image = agent.live(rate=0, start=3), scene(60, 60)
    with torch.inference_mode():
        explored = agent.explore(image, start=3, shifts=6, min_gain=0)
    for cell, map_, _ in zip(explored.cells, explored.probabilities, range(7), strict=True):
        moment = live.step(image)
        assert moment.cell == cell
        assert torch.equal(moment.belief.class_probabilities()[0], map_)
        assert torch.equal(moment.probability, 1 - map_[:, 0])


def test_dirichlet_parameters_return_to_the_prior_exponentially():
    """t seconds without detections multiply β − β₀ by e^(−rt)."""
    agent = agent_with(Semantic(3, prior=0.25))
    live = agent.live("green", rate=2, start=0)
    first = live.step(scene(4)).belief.beta
    assert first.max() > 0.6
    for _ in range(5):
        last = live.step(torch.full((3, 120, 160), 0.4), passed=0.1).belief.beta
    torch.testing.assert_close(last - 0.25, math.exp(-1) * (first - 0.25), atol=1e-6, rtol=1e-5)
    later = live.step(torch.full((3, 120, 160), 0.4), passed=0.25).belief.beta
    torch.testing.assert_close(later - 0.25, math.exp(-1.5) * (first - 0.25), atol=1e-6, rtol=1e-5)
    refused("passed: expected a number", live.step, torch.full((3, 120, 160), 0.4), passed=math.nan)


def test_the_belief_follows_a_moving_target_and_old_evidence_fades():
    """A square moves from the left to the right, and the most probable cell moves with it."""
    live = agent_with(Semantic(3)).live("green", rate=7.5, seed=1)
    frames, grid = [], Grid(8, 6, SIZE)
    for x in [8] * 12 + list(range(8, 129, 8)) + [128] * 12:
        moment = live.step(scene(x))
        frames.append((x, moment))
    begun, ended = frames[11][1], frames[-1][1]
    left = grid.footprint(torch.tensor([[8.0, 8, 32, 32]]))[0]
    right = grid.footprint(torch.tensor([[128.0, 8, 152, 32]]))[0]
    assert left[begun.probability.argmax()]
    assert right[ended.probability.argmax()]
    assert begun.probability[left].max() > 0.7
    assert ended.probability[left & ~right].max() < 0.45
    still = agent_with(Semantic(3)).live("green", rate=0, seed=1)
    for x, _ in frames:
        kept = still.step(scene(x))
    assert kept.probability[left].max() > 0.7, "at rate 0 nothing is forgotten"
    # Each frame is fixated at the cell chosen after the frame before.
    for (_, before), (_, after) in pairwise(frames):
        assert after.cell == before.next_cell


def test_cells_can_be_fixated_again_after_the_half_life_of_evidence():
    live, picture = (
        agent_with(Semantic(3)).live("green", rate=math.log(2) / 0.18, start=0),
        torch.full((3, 120, 160), 0.4),
    )
    cells = []
    for _ in range(40):
        moment = live.step(picture)
        cells.append(moment.cell)
        assert set(moment.visited.nonzero()[:, 0].tolist()) == set(cells[-5:])
    assert len(set(cells)) < 40


def test_after_all_cells_the_gaze_returns_to_the_oldest_fixation():
    agent = agent_with(Semantic(3))
    agent.columns, agent.rows = 3, 2
    live = agent.live("green", rate=0)
    cells = [live.step(scene(50)).cell for _ in range(18)]
    assert sorted(cells[:6]) == list(range(6))
    assert cells == cells[:6] * 3


def test_cells_count_as_visited_up_to_an_age():
    age = torch.tensor([[0.0, 3, 4, torch.inf], [0, 1, 2, 3]])
    assert Forgetting(math.log(2) / 3.5).visited(age).tolist() == [
        [True, True, False, False],
        [True, True, True, False],
    ]
    for rate in (-0.1, math.nan, True, "fast"):
        refused("rate: expected a number from 0", Forgetting, rate)


def test_forgetting_is_a_value_whose_share_and_span_cannot_outlive_its_rate():
    forgetting = Forgetting(0.1)
    assert (repr(forgetting), forgetting) == ("Forgetting(rate=0.1)", Forgetting(0.1))
    assert forgetting != Forgetting(0.2)
    with pytest.raises(FrozenInstanceError):
        forgetting.rate = 0.2


class Deciding(Semantic):
    """An observer with thresholds, so that a search can decide."""

    thresholds = Thresholds(0.6, 0.01)


def test_each_frame_has_a_decision():
    live = agent_with(Deciding(3)).live("green", rate=5, start=9)
    outcomes = [live.step(scene(8)).decision for _ in range(8)]
    assert outcomes[-1].outcome == "found"
    x1, y1, x2, y2 = outcomes[-1].box.tolist()
    assert x1 < 20 < x2
    assert y1 < 20 < y2
    gone = [live.step(torch.full((3, 120, 160), 0.4)).decision for _ in range(30)]
    assert gone[-1].outcome != "found"
    assert gone[-1].probability < 0.5
    assert agent_with(Semantic(3)).live("green").step(scene(8)).decision is None
    stream = agent_with(Deciding(3)).fovea.stream(2, StreamSettings(rate=2.5, confirm=1.0))
    assert stream.plan.thresholds == Thresholds(1.0, 0.01)


@pytest.mark.parametrize("how", ["fovea", "windows"])
def test_a_film_gives_the_same_beliefs_in_any_container(tmp_path, how):
    """Frames at 30 a second, of which a third is left out: MP4 states a mean rate, Matroska rounds its time stamps."""
    times = [0, 1, 2, 3, 6, 7, 10, 11, 12, 30, 31, 32]
    pictures = [(scene(8 * number).permute(1, 2, 0) * 255).byte().numpy() for number in range(len(times))]
    films = {}
    for end in ("mp4", "mkv", "avi", "webm"):
        stream = open_stream(encode(tmp_path / f"film.{end}", "libvpx-vp9", times, pictures))
        live = agent_with(observers()["search"]).live("green", how=how, start=3 if how == "fovea" else None)
        films[end] = [(picture, live.step(picture.image, picture.passed)) for picture in stream.frames]
        assert not stream.gaps["lost"]
    for film in films.values():
        seconds = [picture.passed for picture, _ in film[1:]]
        assert seconds == pytest.approx(np.diff(times) / 30, abs=1e-9)
        for (picture, moment), (first, expected) in zip(film, films["mp4"], strict=True):
            assert torch.equal(picture.image, first.image)
            assert moment.next_point == expected.next_point
            if how == "fovea":
                torch.testing.assert_close(moment.probability, expected.probability, atol=1e-6, rtol=0)
            else:
                assert [look.window for look in moment.window_looks] == [look.window for look in expected.window_looks]
                torch.testing.assert_close(moment.objects.scores, expected.objects.scores, atol=1e-6, rtol=0)


def test_frames_may_have_any_type_but_must_have_the_same_size():
    live = agent_with(Semantic(3)).live("green")
    live.step((scene(8).permute(1, 2, 0).numpy() * 255).astype(np.uint8))
    with pytest.raises(InputError, match=r"frame: expected 160 × 120 pixels, the size of the first frame, got 80 × 60"):
        live.step(torch.rand(3, 60, 80))
    refused("frame: expected one picture", live.step, torch.rand(2, 3, 120, 160))
    for wrong in ({"target": "gren"}, {"start": 48}, {"seed": -1}, {"rate": -1}, {"confirm": 50}):
        refused(f"^{next(iter(wrong))}: ", agent_with(Semantic(3)).live, **wrong)
    with pytest.raises(InputError, match="observer: expected one whose belief can fade, got NotFading"):
        agent_with(NotFading(3)).live("green").step(scene(8))


class NotFading(Semantic):
    """An observer that does not implement fading."""

    fade = Semantic.__mro__[1].fade


def test_frames_of_opencv_give_the_same_moments():
    """Bytes with blue first, and the same picture as a tensor."""
    image = scene(100, 80)
    picture = (image * 255).round() / 255
    frame = (picture * 255).byte().permute(1, 2, 0).flip(-1).numpy()
    observer = observers()["search"]
    moments = [
        agent_with(observer).live("green", start=3, color=color).step(each)
        for color, each in (("rgb", picture), ("bgr", frame), ("bgr", picture.flip(0)))
    ]
    for moment in moments[1:]:
        assert torch.equal(moment.probability, moments[0].probability)
        assert torch.equal(moment.seen.scores, moments[0].seen.scores)
    assert int(moments[0].seen.labels[0, 0]) == 2
    refused("order of channels", agent_with(observer).live, "green", color="brg")


@pytest.mark.parametrize("how", ["fovea", "windows"])
@pytest.mark.parametrize("kind", ["array", "tensor", "floats"])
def test_a_moment_keeps_the_bytes_of_its_frame_also_where_the_next_one_takes_its_memory(kind, how):
    live, pixels = agent_with(Semantic(3)).live("green", how=how), scene(100, 80).mul(255).round().to(torch.uint8)
    frame = {"array": pixels.permute(1, 2, 0).numpy().copy(), "tensor": pixels.clone(), "floats": pixels / 255}[kind]
    moment = live.step(frame)
    frame *= 0
    assert torch.equal(moment.photograph, pixels)


@pytest.mark.parametrize("sought", ["person", ["person"]])
def test_the_window_that_a_moment_names_is_looked_at_in_the_next_frame_of_a_moving_camera(sought):
    live = ActivePerception.recommended("yolox-nano").live(sought, how="windows")
    sheet = F.interpolate(semfov.example("sheet")[None], size=(1200, 1800), mode="bilinear")[0].clamp(0, 1)
    moments = []
    for number in range(8):
        left = 36 * number
        frame = sheet[:, 100:1000, left : left + 1500]
        moments.append(live.step(frame, pose=[[1.0, 0.0, float(-left)], [0.0, 1.0, 0.0]]))
    pairs = [(first, then) for first, then in pairwise(moments) if then.examined is None]
    assert len(pairs) >= 4
    assert [then.window for _, then in pairs] == [first.next_window for first, _ in pairs]


def test_fainter_objects_are_listed_from_the_probability_that_is_asked_for():
    agent = ActivePerception.recommended()
    frame = semfov.example("sheet")
    usual = agent.live(["person"]).step(frame)
    fainter = agent.live(["person"], score_threshold=0.05).step(frame)
    shown = usual.candidates.scores
    assert len(fainter.objects) == int((shown >= 0.05).sum()) > len(usual.objects) == int((shown >= 0.2).sum())
    # What nothing fades in is listed as in a picture.
    assert agent.live(["person"], rate=0).step(frame).score_threshold == 0.5
    refused(
        "score_threshold: expected None for a fovea, or how='windows', got 0.05",
        agent.live,
        how="fovea",
        score_threshold=0.05,
    )
    refused("passes: expected 1 for a fovea, or how='windows', got 2", agent.live, how="fovea", passes=2)


@pytest.mark.parametrize(("how", "size"), [("fovea", (480, 640)), ("windows", (960, 1280))])
def test_a_moment_that_is_read_later_is_the_one_that_is_read_at_once(how, size):
    """Each frame, which is reduced for the moment of a fovea, is written over the one before."""

    def moments():
        live = agent_with(observers()["search"]).live("green", seed=5, how=how, rate=0.3)
        buffer = np.empty((960, 1280, 3), np.uint8)
        for number in range(6):
            small = (scene(20 * number) * 255).byte().permute(1, 2, 0).numpy()
            buffer[:] = small.repeat(8, 0).repeat(8, 1)
            yield live.step(buffer, 0.2)

    def told(moment):
        objects = [getattr(moment.objects, name).tolist() for name in ("boxes", "scores", "labels", "passes")]
        belief = (moment.probability.tolist(), moment.visited.tolist()) if how == "fovea" else None
        return moment.describe(), moment.found, objects, belief, moment.next_point, moment.photograph.tolist()

    at_once = [told(moment) for moment in moments()]
    kept = list(moments())
    # No more than the last moments keep their whole frames in memory.
    assert [isinstance(vars(moment)["photograph"], torch.Tensor) for moment in kept] == [True] * 4 + [False] * 2
    assert [told(moment) for moment in kept] == at_once
    assert kept[0].photograph.shape == (3, *size)


@pytest.mark.parametrize(("how", "function"), [("fovea", "_reduced"), ("windows", "reduced_copy")])
def test_a_moment_that_nobody_keeps_makes_no_photograph(how, function, monkeypatch):
    reduced = []
    kind = {"fovea": "fovea_episode", "windows": "window_episode"}[how]
    monkeypatch.setattr(f"semfov.agents.{kind}.{function}", lambda *frame: reduced.append(frame))
    live = agent_with(observers()["search"]).live("green", seed=5, how=how, rate=0.3)
    for number in range(6):
        moment = live.step(scene(20 * number), 0.2)
    assert moment.number == 5
    assert not reduced


@pytest.mark.slow
@pytest.mark.parametrize("step", [0, 4, 12])
def test_a_target_is_found_while_the_camera_moves(step):
    """The closer look that is due is made in the next frame, where the camera has moved on."""
    beach = F.interpolate(example("beach")[None], scale_factor=2, mode="bilinear")[0].clamp(0, 1)
    live = ActivePerception.recommended().live("boat")
    outcomes = []
    for number in range(8):
        left = 20 + step * number
        frame = beach[:, 40:680, left : left + 960]
        # The first pose is that of the scene.
        moment = live.step(frame, pose=[[1.0, 0.0, float(-step * number)], [0.0, 1.0, 0.0]])
        outcomes.append(None if moment.decision is None else moment.decision.outcome)
    assert outcomes[-1] == "found"


def test_a_stream_says_how_it_is_called():
    live = agent_with(Semantic(3)).live("green")
    refused(r"live\.step\(frame\) takes its frames", live, scene(8))
    refused("did you mean passed=", live.step, scene(8), dt=0.1)
    with pytest.raises(AttributeError, match=r"use a new agent\.live\(target\)"):
        _ = live.reset
    moment = agent_with(Semantic(3)).live("green", how="windows").step(scene(8))
    with pytest.raises(AttributeError, match=r"use moment\[-1\]\.fixation"):
        _ = moment.fixation
    assert moment[-1].fixation == moment.window.fixation[:2]
