"""The environments against Gymnasium's own checker, its own vectorised environments, and the annotations of scenes."""

import pickle

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from eval.chance import random_search
from semfov import EmbeddedScenes
from semfov.envs import GazeExplore, GazeSearch, GazeVectorEnv, open_scenery
from semfov.envs.registration import _IDS
from tests.envs.agents import MaskedRandom, run_agent
from tests.refusals import refused, unusable

pytestmark = pytest.mark.slow

KINDS = {"search": GazeSearch, "exploration": GazeExplore}
TASKS = list(KINDS)


def equal(one, other):
    """Whether observations or infos are the same bit for bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[name], other[name]) for name in one)
    if isinstance(one, np.ndarray) and one.dtype == object:  # of the observations at the ends of episodes, or None
        return len(one) == len(other) and all(map(equal, one, other))
    return np.array_equal(one, other)


@pytest.mark.parametrize(
    ("task", "more"), [("search", {"belief": True, "glimpse": 32, "render_mode": "rgb_array"}), ("exploration", {})]
)
def test_environments_pass_the_checker_of_gymnasium(world, task, more):
    """Warnings are errors."""
    env = gymnasium.make(_IDS[task], **world, **more)
    assert isinstance(env.unwrapped, KINDS[task])
    check_env(env.unwrapped)


@pytest.mark.parametrize("task", TASKS)
def test_vectorised_episodes_equal_those_of_gymnasium(sceneries, task):
    """At every reset and every step, with ends of episodes in between."""
    options = {"belief": True, "scenery": sceneries[task]}
    ours = gymnasium.make_vec(_IDS[task], num_envs=3, **options)
    assert isinstance(ours, GazeVectorEnv)
    theirs = SyncVectorEnv([lambda: KINDS[task](**options)] * 3)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    check_same_episodes(ours, theirs, steps=15)


def test_episodes_that_restart_in_the_same_step_equal_those_of_gymnasium(sceneries):
    mode = AutoresetMode.SAME_STEP
    options = {"belief": True, "scenery": sceneries["search"]}
    ours = GazeVectorEnv("search", 3, autoreset_mode=mode, **options)
    theirs = SyncVectorEnv([lambda: GazeSearch(**options)] * 3, autoreset_mode=mode)
    check_same_episodes(ours, theirs, steps=15)


def check_same_episodes(ours, theirs, steps):
    observations, infos = zip(ours.reset(seed=4), theirs.reset(seed=4), strict=True)
    assert equal(*observations)
    assert equal(*infos)
    random, ends = np.random.default_rng(0), 0
    for _ in range(steps):
        actions = random.integers(ours.single_action_space.n, size=3)
        mine, other = ours.step(actions), theirs.step(actions)
        assert equal(mine[0], other[0])
        assert mine[1] == pytest.approx(other[1])
        assert np.array_equal(mine[2], other[2])
        assert np.array_equal(mine[3], other[3])
        final = mine[4].pop("final_obs", None), other[4].pop("final_obs", None)
        assert (final[0] is None) == (final[1] is None)
        if final[0] is not None:
            ended = np.flatnonzero(mine[4]["_final_obs"])
            assert all(equal(final[0][row], final[1][row]) for row in ended)
            mine[4]["final_info"], other[4]["final_info"] = (
                rows_of_infos(results[4]["final_info"], ended) for results in (mine, other)
            )
        assert equal(mine[4], other[4])
        ends += int((mine[2] | mine[3]).sum())
    assert ends > 2


def rows_of_infos(infos, rows):
    """Infos of the given environments; the values of the others have no meaning."""
    return {name: rows_of_infos(each, rows) if isinstance(each, dict) else each[rows] for name, each in infos.items()}


@pytest.mark.parametrize("task", TASKS)
def test_a_seed_repeats_an_episode_and_other_seeds_give_others(sceneries, task):
    def episode(seed):
        env, random = KINDS[task](sceneries[task], belief=True), MaskedRandom(0)
        observation, info = env.reset(seed=seed)
        record = [observation]
        for _ in range(4):
            observation, reward, terminated, _, info = env.step(random(info))
            record.append({**observation, "reward": reward})
            if terminated:
                break
        return record

    first, second = episode(5), episode(5)
    assert len(first) == len(second)
    assert all(equal(a, b) for a, b in zip(first, second, strict=True))
    starts = {tuple(episode(seed)[0]["gaze"].tolist()) for seed in range(8)}
    assert len(starts) > 2


def test_a_search_ends_only_in_cells_that_a_box_of_the_target_overlaps(sceneries):
    """By a loop over the boxes of the scene, for every cell."""
    scenery = sceneries["search"]
    env, scenes = GazeSearch(scenery, look_cost=0.25, find=3.0), EmbeddedScenes(scenery.classes[1:], count=2)
    hits = 0
    for scene in scenery.scenes:
        episode = scenery.episodes(scene)[0]
        annotation = scenes.annotation(scene)
        wide, high = annotation.size[0] / 5, annotation.size[1] / 4
        for cell in range(20):
            left, top = cell % 5 * wide, cell // 5 * high
            hit = any(
                label == episode.target and x1 < left + wide and x2 > left and y1 < top + high and y2 > top
                for (x1, y1, x2, y2), label in zip(annotation.boxes.tolist(), annotation.labels.tolist(), strict=True)
            )
            observation, _ = env.reset(options={"episode": episode})
            assert observation["target"] == episode.target
            _, reward, terminated, truncated, info = env.step(cell)
            assert (terminated, truncated, info["result"]) == (hit, False, float(hit))
            assert reward == pytest.approx(3.0 * hit - 0.25)
            assert info["passes"] == 2
            assert info["pixels"] == 2 * 416 * 416
            hits += hit
    assert 0 < hits < 40


def test_random_gaze_finds_targets_as_often_as_in_closed_form(world):
    """1 - C(N - m, n) / C(N, n) for m target cells; 500 episodes, four standard errors."""
    scenery = open_scenery("search", **{**world, "starts": 500, "policy": "random", "shifts": 3}, targets=["boat"])
    scene = scenery.scenes[0]
    episodes = scenery.episodes(scene)
    envs = GazeVectorEnv("search", 100, scenery, detections=False, autoreset_mode="Disabled")
    ran = run_agent(envs, MaskedRandom(1), episodes)
    expected = random_search(len(episodes[0].goal), 3, cells=20)
    for shifts in (1, 2, 3):
        share = np.mean([0 < each.found_at <= shifts for each in ran])
        error = np.sqrt(expected[shifts] * (1 - expected[shifts]) / len(ran))
        assert share == pytest.approx(expected[shifts], abs=4 * error)


def test_rewards_of_an_exploration_add_up_to_its_success(sceneries):
    env, random = GazeExplore(sceneries["exploration"], look_cost=0.02, find=2.0), MaskedRandom(3)
    _, info = env.reset(seed=1)
    before, total, steps = info["result"], 0.0, 0
    truncated = False
    while not truncated:
        _, reward, _, truncated, info = env.step(random(info))
        total, steps = total + reward, steps + 1
    assert steps == 6
    assert total == pytest.approx(2.0 * (info["result"] - before) - 0.02 * steps, abs=1e-6)
    assert info["result"] != before


def test_a_repeated_look_costs_its_price_and_shows_nothing_new(sceneries):
    env = GazeSearch(sceneries["search"], belief=True)
    observation, info = env.reset(seed=2)
    cell = int(np.flatnonzero(info["action_mask"] == 0)[0])
    again, reward, _, _, later_info = env.step(cell)
    assert reward == -0.05
    assert np.array_equal(again["belief"], observation["belief"])
    assert equal(later_info["detections"], info["detections"])
    assert later_info["passes"] == 2


def test_infos_have_the_detections_of_the_look(sceneries):
    scenery = sceneries["search"]
    env = GazeSearch(scenery)
    _, info = env.reset(seed=0)
    _, _, _, _, info = env.step(7)
    seen = info["detections"]
    grid = scenery.grid(info["scene"])
    with torch.inference_mode():
        live = scenery.eye(scenery.image(info["scene"])[None], grid.centres[7][None])
    assert int(live.count) == seen["mask"].sum() > 0
    assert seen["boxes"][seen["mask"]] == pytest.approx(live.boxes[0].numpy(), abs=1e-3)
    assert seen["scores"][seen["mask"]] == pytest.approx(live.scores[0].numpy(), abs=1e-4)


def test_observations_have_the_belief_and_the_glimpse_of_the_eye(sceneries):
    scenery = sceneries["search"]
    env = GazeSearch(scenery, belief=True, glimpse=48)
    observation, info = env.reset(seed=0)
    assert observation in env.observation_space
    chance, visited, here = observation["belief"].reshape(3, -1)
    assert np.array_equal(visited, 1 - info["action_mask"])
    assert np.array_equal(visited, here)
    assert chance[visited == 1] == 0
    picture = scenery.image(info["scene"]).permute(1, 2, 0).mul(255).numpy()
    assert abs(observation["glimpse"].mean() - picture.mean()) < 6
    assert observation["glimpse"].std() > 10
    moved = env.step(0 if here[0] == 0 else 1)[0]["belief"].reshape(3, -1)
    believed = env.gazes.memory.belief.chance(env.gazes.targets)[0].numpy()
    assert moved[0][moved[1] == 0] == pytest.approx(believed[moved[1] == 0])
    assert (moved[1].sum(), moved[2].sum()) == (2, 1)


def test_stable_baselines_accepts_the_environments(sceneries):
    """Its checker has no complaints; the belief is left out, since it would object that it is not an image."""
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    checker.check_env(GazeSearch(sceneries["search"], glimpse=64))


def test_the_rendered_picture_changes_as_the_episode_goes_on(sceneries):
    env = GazeSearch(sceneries["search"], render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.dtype == np.uint8
    assert first.shape[2] == 3
    assert min(first.shape[:2]) > 200
    env.step(3)
    assert not np.array_equal(env.render(), first)
    assert GazeSearch(sceneries["search"]).render() is None


def test_environments_can_be_made_of_mosaics_photographs_and_targets(world, tmp_path):
    scenery = open_scenery("search", **world, mosaics=1, tiles=(2, 1), targets=["person"])
    assert scenery.grid(0).extent.tolist() == [1280, 480]
    assert {episode.target for episode in scenery.episodes(0)} == {scenery.classes.index("person")}
    env = GazeSearch(scenery)
    assert env.reset(seed=0)[0] in env.observation_space
    unusable("expected at least one with objects to look for", open_scenery, "search", **world, targets=["zebra"])
    refused("did you mean 'cat'", open_scenery, "search", **world, targets=["catt"])
    unusable(r"data.root: no such folder", open_scenery, "search", tmp_path / "nosuch", tmp_path / "nosuch.json")


def test_invalid_calls_are_refused(sceneries):
    scenery = sceneries["search"]
    env = GazeSearch(scenery)
    refused("step: expected an episode in progress, got none; call reset", env.step, 0)
    env.reset()
    refused("action: expected a whole number from 0 to 19", env.step, 20)
    refused("options: expected episode or scene, got start", env.reset, options={"start": 3})
    refused("scenery: expected no options of `open_scenery` beside it, got count", GazeSearch, scenery, count=3)
    refused(r"shift: expected an option of `open_scenery`.* did you mean shifts=", GazeSearch, shift=3)
    refused("render_mode: expected 'rgb_array' or None", GazeSearch, scenery, render_mode="human")
    refused("look_cost", GazeSearch, scenery, look_cost=-1.0)
    with pytest.warns(FutureWarning, match="price is called look_cost now"):
        refused("look_cost", GazeSearch, scenery, price=-1.0)
    envs = GazeVectorEnv("search", 2, scenery)
    refused("step: expected episodes in progress, got none; call reset", envs.step, np.array([0, 1]))
    envs.reset()
    episodes = scenery.episodes(scenery.scenes[0])[:1] * 2
    options = {"episodes": episodes, "scene": 0}
    refused("options: expected no other ones beside episodes, got scene", envs.reset, options=options)
    exploration = sceneries["exploration"]
    other_task = exploration.episodes(exploration.scenes[0])[0]
    refused(r"episode: expected one of Scenery\.episodes", env.reset, options={"episode": other_task})
    refused("actions: expected 2 cells from 0 to 19", envs.step, np.array([0, 20]))
    refused("unknown action 'pixel'", gymnasium.make, _IDS["search"], action="pixel")


def test_actions_are_those_of_the_space(sceneries):
    """Policies of Stable-Baselines3 give arrays without a dimension."""
    env = GazeSearch(sceneries["search"])
    for action in (np.array(1), np.int32(1), 1, np.array([1]), np.uint64(1), 1.0, np.float32(1), None, "1", -1):
        env.reset(seed=0)
        if env.action_space.contains(action):
            env.step(action)
        else:
            refused("action: expected a whole number from 0 to 19", env.step, action)
    env.reset(seed=0)
    assert env.step(torch.tensor(2))[0]["gaze"].tolist() == (env.reset(seed=0), env.step(2))[1][0]["gaze"].tolist()
    for action in (True, torch.tensor(True), torch.tensor(2.0), torch.tensor([1, 2])):
        refused("action: expected a whole number from 0 to 19", env.step, action)
    envs = GazeVectorEnv("search", 2, sceneries["search"])
    envs.reset()
    envs.step([0, 1])
    refused("actions: expected 2 cells", envs.step, [0.9, 1.7])
    for mask in ([True], [True, False, True], ["a", "b"], [0.5, 1]):
        refused("reset_mask: expected 2 booleans", envs.reset, options={"reset_mask": mask})
    envs.reset(options={"reset_mask": [True, False]})
    for options in ({"episode": "x"}, {"episode": None}):
        refused(r"episode: expected one of Scenery\.episodes", env.reset, options=options)
    refused(r"episode: expected one of Scenery\.episodes", envs.reset, options={"episodes": ["x", "y"]})


def test_copies_of_environments_begin_the_same_episodes(sceneries):
    for env in (
        GazeSearch(sceneries["search"], belief=True),
        GazeVectorEnv("exploration", 2, sceneries["exploration"]),
    ):
        twin = pickle.loads(pickle.dumps(env))
        assert equal(env.reset(seed=3)[0], twin.reset(seed=3)[0])


@pytest.mark.parametrize("task", TASKS)
def test_a_restored_environment_goes_on_as_it_did(sceneries, task):
    """Observations, rewards, infos, pictures and later resets; from one state, twice, and in another environment."""
    options = {"belief": True, "glimpse": 24, "render_mode": "rgb_array"}
    env, other = (KINDS[task](sceneries[task], **options) for _ in range(2))
    refused("save_state: expected an episode, got none; call reset first", env.save_state)
    env.reset(seed=1)
    env.step(3)
    state = env.save_state()
    cells = np.flatnonzero(env.action_masks())[:3]

    def goes_on(env):
        went = [env.step(int(cell)) for cell in cells]
        return [*went, env.render(), env.reset(), *(env.step(int(cell)) for cell in cells)]

    first = goes_on(env)
    for each in (env, other, env):
        if each is other:  # it has opened scenes in another order, and an episode in another scene
            other.reset(options={"scene": sceneries[task].scenes[-1]})
        each.restore(state)
        assert same(goes_on(each), first)


def same(one, other):
    """Whether what steps and resets have returned is the same bit for bit."""
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(same(*pair) for pair in zip(one, other, strict=True))
    return equal(one, other)


@pytest.mark.parametrize(
    ("task", "mode"), [("search", "NextStep"), ("search", "SameStep"), ("exploration", "SameStep")]
)
def test_restored_environments_side_by_side_go_on_as_they_did(sceneries, task, mode):
    envs = GazeVectorEnv(task, 3, sceneries[task], belief=True, autoreset_mode=mode)
    envs.reset(seed=2)
    random = np.random.default_rng(1)
    for _ in range(3):
        envs.step(random.integers(20, size=3))
    state = envs.save_state()
    actions = [random.integers(20, size=3) for _ in range(8)]
    first = [envs.step(each) for each in actions]
    assert any((step[2] | step[3]).any() for step in first)  # episodes end, and others are drawn
    for _ in range(2):
        envs.restore(state)
        assert same([envs.step(each) for each in actions], first)


def test_states_of_other_environments_are_refused(sceneries, world):
    env = GazeSearch(sceneries["search"])
    env.reset(seed=0)
    refused("state: expected what .* gave, got a dict", env.restore, {})
    two = GazeVectorEnv("search", 2, sceneries["search"])
    refused("state: .* a GazeVectorEnv, got one of a single environment", two.restore, env.save_state())
    three = GazeVectorEnv("search", 3, sceneries["search"])
    two.reset(seed=0)
    refused(r"state: .*\(search, episodes: 3\), got search, episodes: 2", three.restore, two.save_state())
    for other in ({"count": 1}, {"shifts": 5}, {"targets": ["person"]}, {"grid": (4, 5)}, {"seed": 1}):
        another = GazeSearch(open_scenery("search", **world | other))
        for state in (env.save_state(), pickle.loads(pickle.dumps(env.save_state()))):
            refused("state: .* got one of other scenes; open both .* the same settings", another.restore, state)


def test_states_of_scenes_without_a_fingerprint_stay_in_their_environment(sceneries, world):
    scenery = open_scenery("search", **world)
    del scenery.pictures.fingerprint
    env = GazeSearch(scenery)
    env.reset(seed=0)
    state = env.save_state()
    first = env.step(3)
    env.restore(state)
    assert same(env.step(3), first)
    message = "scenes: expected a `fingerprint`, sha256 of what they depend on, got none"
    refused(message, pickle.dumps, state)
    refused(message, GazeSearch(sceneries["search"]).restore, state)


@pytest.mark.parametrize("task", TASKS)
def test_a_pickled_state_goes_on_in_another_process(sceneries, world, task, fresh, tmp_path):
    """A planner gives each of its workers a state and an action; each has opened the same scenes itself."""
    env = KINDS[task](sceneries[task], belief=True, render_mode="rgb_array")
    env.reset(seed=2)
    env.step(int(np.flatnonzero(env.action_masks())[0]))
    (tmp_path / "state").write_bytes(pickle.dumps(env.save_state()))
    cells = np.flatnonzero(env.action_masks())[:3]
    code = f"""
import pathlib, pickle
from semfov.envs import {KINDS[task].__name__} as Kind
if __name__ == "__main__":
    env = Kind(count=2, grid=(5, 4), shifts=6, starts=3, cache={str(world["cache"])!r}, belief=True,
               render_mode="rgb_array")
    state = pickle.loads(pathlib.Path({str(tmp_path / "state")!r}).read_bytes())
    for _ in range(2):
        env.restore(state)
        went = [env.step(cell) for cell in {cells.tolist()}] + [env.render(), env.reset()]
    pathlib.Path({str(tmp_path / "went")!r}).write_bytes(pickle.dumps(went))
"""
    fresh(code)
    went = pickle.loads((tmp_path / "went").read_bytes())
    assert same(went, [*(env.step(int(cell)) for cell in cells), env.render(), env.reset()])


def test_a_state_that_is_refused_changes_nothing(sceneries):
    """One of several environments, though it is of one episode; and one without pictures where they are drawn."""
    scenery = sceneries["search"]
    plain = GazeSearch(scenery)
    drawing = GazeSearch(scenery, render_mode="rgb_array")
    single = GazeVectorEnv("search", 1, scenery)
    for each in (plain, drawing, single):
        each.reset(seed=4)
    pairs = [
        (plain, single, "a single environment, got one of a GazeVectorEnv"),
        (single, plain, "a GazeVectorEnv, got one of a single environment"),
        (drawing, plain, "with `render_mode=`, got one without"),
    ]
    for env, other, message in pairs:
        other.step(np.array([5]) if other is single else 5)
        before = env.save_state()
        refused(f"state: .*{message}", env.restore, other.save_state())
        after = env.save_state()
        assert torch.equal(before.gazes.shift, after.gazes.shift)
        assert torch.equal(before.gazes.looks.cell, after.gazes.looks.cell)
    assert drawing.render() is not None


def test_ended_environments_stay_idle_until_they_are_reset(sceneries):
    scenery = sceneries["search"]
    envs = GazeVectorEnv("search", 2, scenery, autoreset_mode="Disabled")
    episode = scenery.episodes(0)[0]
    envs.reset(options={"episodes": [episode, episode]})
    away = next(cell for cell in range(20) if cell not in episode.goal and cell != episode.start)
    _, rewards, terminated, _, infos = envs.step(np.array([episode.goal[0], away]))
    assert terminated.tolist() == [True, False]
    _, rewards, terminated, _, infos = envs.step(np.array([away, away]))
    assert (rewards[0], terminated[0], infos["passes"].tolist()) == (0, True, [2, 3])
    _, infos = envs.reset(options={"reset_mask": np.array([True, False])})
    assert infos["passes"].tolist() == [1, 3]


def test_importing_registers_the_names_once(fresh):
    """In a separate process, where nothing was registered before."""
    code = (
        "import gymnasium, warnings\n"
        "warnings.simplefilter('error', UserWarning)\n"
        "import semfov.envs\n"
        "from semfov.envs.registration import register\n"
        "register()\n"
        "print(sorted(name for name in gymnasium.registry if 'semfov' in name))"
    )
    assert fresh(code).strip() == str(sorted(_IDS.values()))


def test_without_gymnasium_the_error_has_the_install_command(fresh):
    code = (
        "import sys; sys.modules['gymnasium'] = None\n"
        "from semfov.errors import DataError\n"
        "try:\n    import semfov.envs\nexcept DataError as error:\n    print(error)"
    )
    assert 'pip install "semfov[envs]"' in fresh(code)


def test_arguments_of_other_kinds_are_refused_by_name(sceneries, world):
    vector = GazeVectorEnv("search", 2, scenery=sceneries["search"])
    vector.reset(seed=0)
    for call, said in (
        (lambda: open_scenery("search", 3), "scenes: expected a folder or `Scenes`"),
        (lambda: open_scenery("search", **{**world, "grid": 10}), r"grid: expected \(columns, rows\), got 10"),
        (lambda: GazeSearch(scenery="photographs"), "scenery: expected what `open_scenery` makes, got a str"),
        (lambda: GazeVectorEnv("find", 2), "unknown task 'find'; .*search"),
        (lambda: GazeSearch(sceneries["search"]).reset(options=[1]), "options: expected a dictionary, got a list"),
        (
            lambda: vector.reset(options={"reset_mask": [False, False]}),
            "reset_mask: expected 2 booleans, .* one of them",
        ),
    ):
        refused(f"^{said}", call)
