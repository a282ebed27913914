"""Policies in settings: names, mappings, labels in tables, and which are refused."""

from dataclasses import replace
from itertools import combinations
from typing import get_args

import pytest

from eval.explore.run import ExploreConfig
from eval.search.run import SearchConfig
from semfov.errors import InputError
from semfov.gaze.acquisition.base import Task
from semfov.gaze.policies import policy_names
from semfov.runs.command import run_command
from semfov.runs.config import PolicyConfig
from semfov.runs.presets import _WORDS, TARGET_EVIDENCE, label, presets, resolve
from tests.refusals import refused

TASKS = get_args(Task)
ALIASES = {
    "search": {
        "recommended": "target-evidence",
        "published": "predictive-calibrated",
        "maximum-a-posteriori-raw": "non-predictive-raw",
        "maximum-a-posteriori-calibrated": "non-predictive-calibrated",
        "maximum-a-posteriori-learned": "target-evidence",
    },
    "exploration": {"recommended": "closer-look-learned", "published": "kl-calibrated"},
}

# One change each; together they cover every allowed word of every setting.
CHANGES = [
    {"tempering": 0.25},
    {"tempering": 0.5},
    {"tempering": 1.0},
    {"misses": True},
    {"misses": False},
    {"samples": 4},
    *({name: word} for name, words in _WORDS.items() if name != "scores" for word in get_args(words)),
]


def test_names_give_policy_scores_and_saliency():
    assert resolve("predictive-calibrated", "search") == PolicyConfig("predictive", "calibrated")
    assert resolve("place-information-raw", "search") == PolicyConfig("place-information", "raw")
    assert resolve("entropy-limit-learned", "search") == PolicyConfig("entropy-limit", "learned")
    assert resolve("vocus2", "search") == PolicyConfig("saliency", saliency="vocus2")
    assert resolve("expected-accuracy-raw", "exploration") == PolicyConfig("expected-accuracy")
    assert resolve("itti-koch-calibrated", "exploration") == PolicyConfig(
        "saliency", "calibrated", saliency="itti-koch"
    )
    assert resolve("recommended", "search") == PolicyConfig("target-evidence")
    assert resolve("recommended", "exploration") == PolicyConfig("closer-look", "learned")
    assert resolve("published", "search") == PolicyConfig("predictive", "calibrated")
    assert resolve("published", "exploration") == PolicyConfig("kl", "calibrated")


@pytest.mark.parametrize("task", TASKS)
def test_every_policy_has_a_preset_with_its_name(task):
    made = {preset.policy for preset in presets(task).values()}
    assert made == {*policy_names(task), *[TARGET_EVIDENCE] * (task == "search")}
    for name, preset in presets(task).items():
        assert resolve(name, task) == resolve(preset, task) == preset
    for name in presets(task):
        assert label(name, task) == ALIASES[task].get(name, name)


@pytest.mark.parametrize("task", TASKS)
def test_labels_are_unique(task):
    """Two policies with the same label would be merged in the tables of a run."""
    several = [{}, *CHANGES, *({**one, **other} for one, other in combinations(CHANGES, 2))]
    made = set()
    for preset in presets(task).values():
        for change in several:
            try:
                made.add(resolve(replace(preset, **change), task))
            except InputError:
                continue
    labels = {label(policy, task) for policy in made}
    assert len(labels) == len(made)
    assert labels >= {label(name, task) for name in presets(task)}


def test_labels_list_the_differences_from_a_preset():
    central = PolicyConfig("non-predictive", tempering=0.25, footprint="box_centre")
    assert label(central, "search") == "non-predictive-raw, tempering 0.25, footprint box_centre"
    everything = PolicyConfig("predictive", "calibrated", 1.0, "soft", "closest", True, "vocus2", 9)
    expected = "predictive-calibrated, tempering 1, footprint soft, memory closest, misses, saliency vocus2, samples 9"
    assert label(everything, "search") == expected
    assert label(PolicyConfig("saliency", saliency="itti-koch", misses=False), "search") == "itti-koch, misses false"
    assert label(PolicyConfig("kl", saliency="itti-koch"), "exploration") == "kl-raw, saliency itti-koch"


def test_unknown_names_and_settings_are_refused_with_a_suggestion():
    for choice, task, suggested in [
        ("predicitve-raw", "search", "predictive-raw"),
        ("target-evidenc", "search", "target-evidence"),
        ("recomended", "exploration", "recommended"),
        ("random", "exploration", "random-raw"),
        (PolicyConfig("predictiv"), "search", "predictive"),
        (PolicyConfig("closer-lok"), "exploration", "closer-look"),
        (PolicyConfig("kl", memory="closets"), "exploration", "closest"),
        (PolicyConfig("kl", footprint="box-centre"), "exploration", "box_centre"),
        (PolicyConfig("kl", saliency="vocus"), "exploration", "vocus2"),
        (PolicyConfig("kl", "calibratd"), "exploration", "calibrated"),
    ]:
        for call in (resolve, label):
            refused(f"did you mean '{suggested}'", call, choice, task)
    for task, settings, told in [
        ("search", {"policy": "kl"}, "policy"),
        ("exploration", {"policy": "target-evidence"}, "policy"),
        *((task, {"policy": "saliency"}, "^saliency: .*vocus2, itti-koch") for task in TASKS),
        *(
            ("exploration", {"policy": "kl", "tempering": wrong}, "^tempering: expected a number above 0")
            for wrong in (0.0, -0.5, float("nan"))
        ),
        # Without scores in use, its label would be the same as with raw scores.
        ("search", {"policy": "random", "scores": "calibrated"}, "^scores: .*'random'"),
        ("search", {"policy": "target-evidence", "scores": "calibrated"}, "^scores: .*'target-evidence'"),
        ("search", {"policy": "saliency", "scores": "calibrated", "saliency": "vocus2"}, "^scores: .*'saliency'"),
        # It has a belief of its own, not the map.
        *(
            ("search", {"policy": "target-evidence", name: value}, f"^{name}: .*'target-evidence'")
            for name, value in (("tempering", 0.25), ("footprint", "soft"), ("memory", "all"), ("misses", True))
        ),
    ]:
        with pytest.raises(InputError, match=told):
            resolve(PolicyConfig(**settings), task)


def parsed(config, *arguments):
    """The policies that a command line gives."""
    got = []
    assert run_command(got.append, config, "Policies.", arguments) == 0
    (settings,) = got
    return settings.policies


MAPPING = "[{policy: non-predictive, tempering: 0.25}, random]"


def test_a_policy_can_be_a_mapping(tmp_path):
    assert parsed(SearchConfig, "--policies", MAPPING) == (PolicyConfig("non-predictive", tempering=0.25), "random")
    given = "[recommended, {policy: kl, scores: calibrated, memory: closest, misses: true}]"
    expected = "recommended", PolicyConfig("kl", "calibrated", memory="closest", misses=True)
    assert parsed(ExploreConfig, "--policies", given) == expected
    path = tmp_path / "run.yaml"
    path.write_text(f"policies: {MAPPING}\n")
    assert parsed(SearchConfig, "--config", str(path)) == (PolicyConfig("non-predictive", tempering=0.25), "random")
    path.write_text("policies:\n- policy: saliency\n  saliency: vocus2\n- kl-raw\n")
    assert parsed(ExploreConfig, "--config", str(path)) == (PolicyConfig("saliency", saliency="vocus2"), "kl-raw")


@pytest.mark.parametrize("config", [SearchConfig, ExploreConfig])
def test_settings_that_a_run_wrote_can_be_read_back(config, tmp_path):
    policies = (PolicyConfig("random", saliency="vocus2"), *config().policies)
    path = tmp_path / "config.yaml"
    path.write_text(replace(config(), policies=policies).yaml())
    assert parsed(config, "--config", str(path)) == policies


BAD = {
    "temperring": "{policy: non-predictive, temperring: 0.25}",
    "tempering": "{policy: non-predictive, tempering: cold}",
    "scores": "{policy: non-predictive, scores: cooked}",
    "policy": "{tempering: 0.25}",
}


@pytest.mark.parametrize("wrong", BAD)
def test_an_invalid_mapping_is_refused(wrong, tmp_path, capsys):
    """On the command line the parser may read such a mapping as text, which is then an unknown name."""

    def run(config):
        for choice in config.policies:
            resolve(choice, "search")

    path = tmp_path / "run.yaml"
    path.write_text(f"policies:\n- {BAD[wrong]}\n")
    for given in (["--config", str(path)], ["--policies", f"[random, {BAD[wrong]}]"]):
        try:
            code = run_command(run, SearchConfig, "Policies.", given)
        except SystemExit as stopped:
            code = stopped.code
        assert code == 2 or (code == 1 and given[0] == "--policies")
        error = capsys.readouterr().err
        assert "policies" in error
        assert wrong in error
