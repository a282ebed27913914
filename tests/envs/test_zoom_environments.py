"""Environments with large pictures: the checker, the choices of the zooming agent, and found objects."""

import pickle
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from semfov import InputError
from semfov.envs import ZoomEnv, open_zoom_scenery
from semfov.envs.registration import _IDS
from semfov.envs.windows import _window_of
from semfov.zoom.episode import find_everything, look_for
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window
from tests.envs.agents import WindowAgent
from tests.envs.test_environments import same
from tests.refusals import refused

KINDS = {task: partial(ZoomEnv, task) for task in ("search", "exploration")}
EVERYTHING = {"belief": True, "grid": (6, 4), "glimpse": 32, "render_mode": "rgb_array"}


@given(
    size=st.tuples(st.integers(200, 9000), st.integers(200, 9000)),
    place=st.tuples(*[st.floats(0, 1)] * 3),
    number=st.integers(0, 10**6),
)
def test_an_action_selects_the_nearest_window_and_converts_back(size, place, number):
    """The nearest of its level by the distance between centres, against trying all windows."""
    lattice = Lattice.over(size, (416, 416))
    window = _window_of(lattice, np.array(place))
    assert window.level == round(place[2] * (lattice.levels - 1))
    middle = np.array(place[:2]) * size
    actions = lattice.actions[lattice.actions[:, 0] == window.level]
    boxes = lattice.boxes(actions).double().numpy()
    away = np.abs((boxes[:, :2] + boxes[:, 2:]) / 2 - middle).max(-1)
    mine = np.abs(np.array(window.fixation[:2]) + 0.5 - middle).max()
    assert mine <= away.min() + 1e-2
    level, column, row = lattice.actions[number % len(lattice)].tolist()
    same = Window.on(lattice, (level, column, row))
    x, y = (np.array(same.fixation[:2]) + 0.5) / size
    share = np.clip([x, y, level / max(lattice.levels - 1, 1)], 0, 1).astype(np.float32)
    assert _window_of(lattice, share.astype(np.float64)) == same


@pytest.mark.slow
@pytest.mark.parametrize("task", KINDS)
def test_environments_pass_the_checker_of_gymnasium(cache, task):
    env = gymnasium.make(_IDS[task], action="window", mosaics=1, tiles=(2, 1), passes=6, cache=cache, **EVERYTHING)
    assert isinstance(env.unwrapped, ZoomEnv)
    check_env(env.unwrapped)


@pytest.mark.slow
@pytest.mark.parametrize("task", KINDS)
def test_a_restored_environment_goes_on_as_it_did(zoom_scenery, task, monkeypatch):
    """Observations, rewards, infos, pictures and later resets, without a pass of the detector."""
    env = KINDS[task](zoom_scenery, **EVERYTHING)
    env.reset(seed=1)
    random = np.random.default_rng(0)
    env.step(random.random(3))
    state = env.save_state()
    actions = random.random((3, 3))

    def goes_on():
        return [*(env.step(each) for each in actions), env.render(), env.reset(), env.step(actions[1])]

    first = goes_on()
    monkeypatch.setattr(env.gazes.source.looks, "_look", lambda window: pytest.fail("a look was computed again"))
    for _ in range(2):
        env.restore(state)
        assert same(goes_on(), first)


def test_a_pickled_state_goes_on_in_pictures_that_were_opened_again(zoom_scenery, cache):
    env = ZoomEnv("search", zoom_scenery, belief=True)
    env.reset(seed=1)
    env.step([0.2, 0.3, 1.0])
    pickled = pickle.dumps(env.save_state())
    again = ZoomEnv("search", open_zoom_scenery(mosaics=1, tiles=(3, 2), passes=6, cache=cache), belief=True)
    again.restore(pickle.loads(pickled))
    actions = np.random.default_rng(0).random((2, 3))
    assert same([again.step(each) for each in actions], [env.step(each) for each in actions])
    for options in ({"mosaics": 1, "tiles": (2, 2), "passes": 6}, {"mosaics": 1, "tiles": (3, 2), "passes": 7}):
        other = ZoomEnv("search", open_zoom_scenery(**options, cache=cache))
        refused("state: .* other scenes", other.restore, pickle.loads(pickled))


def shown_in(env):
    """What each look of the episode of an environment shows."""
    return [look.shown for look in env.gazes.looking.looks]


@pytest.mark.slow
def test_the_environment_repeats_the_search_of_the_zooming_agent(zoom_scenery):
    """Window by window, until an object is found by its box."""
    env = ZoomEnv("search", zoom_scenery)
    agent, lengths = WindowAgent(env), set()
    targets = zoom_scenery.episodes(0)
    assert targets
    for target in targets:
        env.reset(options={"scene": 0, "target": target})
        over = False
        while not over:
            _, reward, terminated, truncated, info = env.step(agent())
            over = terminated or truncated
        seen = [look.window for look in shown_in(env)]
        steps = look_for(zoom_scenery.looks_at(0), zoom_scenery.evidence, target)
        assert seen == [step.look.window for step, _ in zip(steps, seen, strict=False)]
        assert terminated == zoom_scenery.found(shown_in(env), 0, target)
        assert not zoom_scenery.found(shown_in(env)[:-1], 0, target)
        assert reward == pytest.approx(terminated - 0.05)
        assert info["passes"] == len(seen)
        lengths.add(len(seen))
    assert min(lengths) >= 2


@pytest.mark.slow
def test_the_environment_repeats_the_exploration_of_the_zooming_agent(zoom_scenery):
    refused("unknown task 'explore'", ZoomEnv, "explore", zoom_scenery, look_cost=0.5)
    env = ZoomEnv("exploration", zoom_scenery, look_cost=0.5, find=10.0)
    agent = WindowAgent(env)
    _, info = env.reset(seed=0)
    before, total, truncated = info["result"], 0.0, False
    while not truncated:
        _, reward, _, truncated, info = env.step(agent())
        total += reward
    assert len(shown_in(env)) == info["passes"] == 6
    steps = find_everything(zoom_scenery.looks_at(0), zoom_scenery.evidence)
    expected = [step.look.window for step, _ in zip(steps, range(6), strict=False)]
    assert [look.window for look in shown_in(env)] == expected
    assert total == pytest.approx(10 * (info["result"] - before) - 0.5 * 5)
    assert info["result"] > before


@pytest.mark.slow
def test_observations_and_infos_follow_the_windows(zoom_scenery):
    env = ZoomEnv("exploration", zoom_scenery, **EVERYTHING)
    observation, info = env.reset(seed=0)
    lattice = env.gazes.source.lattice
    assert lattice.levels >= 3
    assert info["action_mask"].sum() == len(lattice) - 1
    closest = np.array([0.0, 0.0, 1.0], np.float32)
    observation, _, _, _, info = env.step(closest)
    assert observation["gaze"][2] == 1
    assert info["action_mask"][lattice.number(lattice.levels - 1, 0, 0)] == 0
    assert info["pixels"] == 2 * 416 * 416
    expected, near = observation["belief"]
    assert near.max() == near[0, 0] == 1
    assert near.min() == pytest.approx(1 / lattice.levels)
    assert 0 < expected.max() <= 1
    same, reward, _, _, later_info = env.step(closest)
    assert reward == -0.01
    assert np.array_equal(same["belief"], observation["belief"])
    assert later_info["passes"] == 3
    refused(r"action: expected \(x, y, magnification\)", env.step, np.array([0.0, 1.5, 0.0]))


@pytest.mark.slow
def test_environments_can_be_made_of_pictures_without_annotations(zoom_scenery, cache, tmp_path):
    """Targets detected with a score of at least 0.3 count as found; pictures may have any size."""
    picture = zoom_scenery.image(0).permute(1, 2, 0).mul(255).byte().numpy()
    Image.fromarray(picture).save(tmp_path / "a.png")
    Image.fromarray(picture[:900, :1100]).save(tmp_path / "b.png")
    scenery = open_zoom_scenery(tmp_path, passes=5, targets=["cat", "person"], cache=cache)
    assert not scenery.annotated
    env = ZoomEnv("search", scenery)
    for seed in range(3):
        env.reset(seed=seed)
        env.action_space.seed(seed)
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
        shown = [float(look.show[env.gazes.episodes[0].target - 1]) for look in shown_in(env)]
        assert max(shown[:-1], default=0) < 0.3
        assert terminated == (shown[-1] >= 0.3)
    explore = ZoomEnv("exploration", scenery)
    _, info = explore.reset(seed=0)
    assert info["result"] == int(info["result"])

    envs = gymnasium.make_vec(_IDS["exploration"], num_envs=2, action="window", scenery=scenery, belief=True)
    assert isinstance(envs, SyncVectorEnv)
    observations, infos = envs.reset(seed=[0, 3])
    assert observations["belief"].shape == (2, 2, 10, 10)
    assert infos["action_mask"].shape == (2, scenery.windows)

    with pytest.raises(InputError, match="targets: expected classes to search for"):
        ZoomEnv("search", open_zoom_scenery(tmp_path, cache=cache)).reset(seed=0)


@pytest.mark.slow
def test_looks_are_cached_between_environments(zoom_scenery, cache, monkeypatch):
    """A second environment with the same pictures needs no detector for looks that the first has made."""
    env = ZoomEnv("exploration", zoom_scenery)
    env.reset(seed=0)
    env.close()
    again = open_zoom_scenery(mosaics=1, tiles=(3, 2), passes=6, cache=cache)

    def refuse(*given, **options):
        raise AssertionError("the detector was called")

    monkeypatch.setattr(again.eye, "detect", refuse)
    kept = again.looks_at(0).see([Window.overview(again.looks_at(0).lattice)])[0]
    assert torch.equal(kept.show, shown_in(env)[0].show)


def test_actions_are_those_of_the_space_and_copies_begin_the_same_episodes(zoom_scenery):
    env = ZoomEnv("search", zoom_scenery)
    for action in ([0.5, 0.2, 0], np.float32([0.5, 0.2, 0]), np.array([0.5, 0.2, 0]), np.array([0, 0, 1])):
        assert env.action_space.contains(np.asarray(action))
        env.reset(seed=0)
        env.step(action)
    env.reset(seed=0)
    of_numbers = env.step([0.5, 0.2, 0])[0]
    env.reset(seed=0)
    assert same(env.step(torch.tensor([0.5, 0.2, 0.0], requires_grad=True))[0], of_numbers)
    for action in ([0.5, 0.2], "x", [2, 0, 0], np.full(3, np.nan), None, np.array(["a", "b", "c"])):
        assert not env.action_space.contains(np.asarray(action))
        env.reset(seed=0)
        refused(r"action: expected \(x, y, magnification\), each from 0 to 1", env.step, action)
    for action in ([True, False, True], np.array([True, False, True])):
        refused(r"action: expected \(x, y, magnification\), each from 0 to 1", env.step, action)
    twin = pickle.loads(pickle.dumps(env))
    assert env.reset(seed=3)[0]["target"] == twin.reset(seed=3)[0]["target"]


def test_options_of_a_reset_and_of_shared_pictures_are_checked(zoom_scenery):
    """No option is dropped: a target needs its scene, and shared pictures are opened already."""
    env = ZoomEnv("exploration", zoom_scenery)
    refused("scene: expected a whole number from 0 to 0", env.reset, options={"scene": 1})
    refused("target: expected a scene to search for it in", env.reset, options={"target": 0})
    for target in (1, "person"):
        refused(r"target: expected one of \[0\]", env.reset, options={"scene": 0, "target": target})
    make = partial(gymnasium.make_vec, _IDS["exploration"], num_envs=2, action="window")
    refused("scenery: expected no options of `open_zoom_scenery` beside it", make, scenery=zoom_scenery, count=1)
    with pytest.warns(FutureWarning, match="price is called look_cost now"):
        envs = make(scenery=zoom_scenery, price=0.25)
    assert {env.unwrapped.gazes.look_cost for env in envs.envs} == {0.25}
    refused("pases: expected an option of `open_zoom_scenery`", make, pases=3)
