"""The settings of tasks: what their types refuse, what suits which kind of look, and the keywords of the agent."""

import inspect
import re
from dataclasses import FrozenInstanceError, fields, replace
from typing import get_args

import numpy as np
import pytest
import torch

from semfov import ActivePerception
from semfov.agents.kinds import KINDS_OF_LOOK
from semfov.cli.main import main
from semfov.cli.options import ExploreOptions, FindOptions, LiveOptions, SearchOptions
from semfov.errors import InputError
from semfov.io.ranges import Range
from semfov.kinds import KindName
from semfov.settings import (
    ExploreSettings,
    FindSettings,
    LookSettings,
    SearchSettings,
    StreamSettings,
    help_of,
)
from tests.refusals import refused

TASKS = {"search": SearchSettings, "find_all": FindSettings, "explore": ExploreSettings, "live": StreamSettings}
OF_PICTURES = {"color", "white", "bands"}  # how a picture is read, which is no setting of its episode


@pytest.mark.parametrize("method", TASKS)
def test_the_settings_of_a_task_are_the_keywords_of_the_agent(method):
    parameters = inspect.signature(getattr(ActivePerception, method)).parameters.values()
    keywords = {each.name: each for each in parameters if each.kind is each.KEYWORD_ONLY}
    settings = {setting.name: setting for setting in fields(TASKS[method])}
    assert keywords.keys() - OF_PICTURES == settings.keys() - OF_PICTURES
    assert {name: keywords[name].default for name in settings} == {
        name: each.default for name, each in settings.items()
    }


@pytest.mark.parametrize("kind", [LookSettings, *TASKS.values()])
def test_every_setting_is_documented_by_the_class_that_has_it(kind):
    own = list(vars(kind).get("__annotations__", {}))
    documented = inspect.getdoc(kind)
    assert [name for name in own if f"\n    {name}: " not in documented] == []


@pytest.mark.parametrize(
    ("command", "options", "task"),
    [
        ("search", SearchOptions, SearchSettings),
        ("find", FindOptions, FindSettings),
        ("explore", ExploreOptions, ExploreSettings),
        ("live", LiveOptions, StreamSettings),
    ],
)
def test_the_options_of_a_command_are_the_settings_of_its_task_with_their_help(command, options, task, capsys):
    assert main([command, "--help-all"]) == 0
    printed = "".join(capsys.readouterr().out.split())  # lines may break within a word
    of_python = {"on_look", "boxes", "policy", "color"}
    for name, entry in help_of(task).items():
        text = "".join(entry.partition(": ")[2].split())
        assert (f"--{name}" in printed and text in printed) == (name not in of_python)
    assert of_python >= set(options.unused)


WRONG = [
    (SearchSettings, {"passes": 0}, "passes: expected a whole number from 1 to 1,000,000, got 0"),
    (SearchSettings, {"passes": True}, "passes: expected a whole number"),
    (SearchSettings, {"passes": "8"}, "passes: expected a whole number from 1 to 1,000,000, got '8'"),
    (FindSettings, {"shifts": 10_001}, "shifts: expected a whole number from 0 to 10,000, got 10001"),
    (FindSettings, {"seconds": -1}, "seconds: expected a number from 0, got -1"),
    (FindSettings, {"seconds": float("nan")}, "seconds: expected a number from 0, got nan"),
    (FindSettings, {"batch": 1.5}, "batch: expected a whole number"),
    (FindSettings, {"score_threshold": 1.5}, "score_threshold: expected a probability from 0 to 1, got 1.5"),
    (ExploreSettings, {"min_gain": -0.1}, "min_gain: expected a number from 0 to 1,000,000,000, got -0.1"),
    (ExploreSettings, {"policy": "cats"}, "policy: expected 'people', or None, got cats"),
    (ExploreSettings, {"seed": 2**63}, "seed: expected a whole number from 0 to 9,223,372,036,854,775,807"),
    (ExploreSettings, {"on_look": 1}, "on_look: expected a function of the record, got 1"),
    (SearchSettings, {"confirm": 1.5}, "confirm: expected a probability from 0 to 1, got 1.5"),
    (SearchSettings, {"prior": 1.0}, "prior: expected a share, such as 0.15, above 0 and below 1, or 'fit', got 1.0"),
    (SearchSettings, {"prior": 0}, "prior: expected a share, such as 0.15, above 0 and below 1, or 'fit', got 0"),
    (SearchSettings, {"prior": "fitted"}, "prior: expected a share, such as 0.15, above 0 and below 1, or 'fit', got"),
    (SearchSettings, {"closer": 101}, "closer: expected a whole number from 0 to 100, got 101"),
    (SearchSettings, {"how": "windws"}, "unknown kind of look 'windws'; did you mean 'windows'"),
    (StreamSettings, {"rate": 101}, "rate: expected a number from 0 to 100, got 101"),
    (StreamSettings, {"color": "grb"}, "unknown order of channels 'grb'"),
]


@pytest.mark.parametrize(("kind", "wrong", "message"), WRONG, ids=str)
def test_values_out_of_range_are_refused(kind, wrong, message):
    with pytest.raises(InputError) as raised:
        kind(**wrong)
    assert str(raised.value).startswith(message)


def test_numbers_of_numpy_and_limits_without_end_are_taken():
    settings = SearchSettings(passes=np.int64(3), confirm=np.float32(0.5), seconds=float("inf"), seed=np.uint8(2))
    assert settings == SearchSettings(passes=3, confirm=0.5, seconds=float("inf"), seed=2)


def test_settings_do_not_change_and_boxes_do_not_count_where_they_are_compared():
    settings = SearchSettings(boxes=torch.zeros(1, 4))
    with pytest.raises(FrozenInstanceError):
        settings.passes = 3
    assert settings == SearchSettings()
    assert replace(settings, passes=3).passes == 3
    refused("passes: expected", replace, settings, passes=-3)


@pytest.mark.parametrize(
    ("settings", "kind", "message"),
    [
        (SearchSettings(shifts=2), "windows", "shifts: expected none for a picture that is looked at by windows, "
         "got 2; use passes=, or how='fovea'"),
        (SearchSettings(duration=2), "fovea", "duration: .* by a fovea, got 2; use seconds=, or how='head'"),
        (SearchSettings(closer=2), "head", "closer: .* by a head that turns, got 2; use confirm, or how='fovea'"),
        (SearchSettings(start=2), "windows", "start: .* use none, or how='fovea'"),
        (SearchSettings(boxes=[(0, 0, 1, 1)]), "head", "boxes: .* use passes, or how='fovea'"),
        (FindSettings(min_gain=0.1), "fovea", "min_gain: .* use passes, or how='windows'"),
        (ExploreSettings(policy="people"), "windows", "policy: .* use none, or how='fovea'"),
    ],
    ids=str,
)  # fmt: skip
def test_settings_of_another_kind_of_look_are_refused_with_what_to_use(settings, kind, message):
    refused(f"^{message}", settings.check_suitable, KINDS_OF_LOOK[kind].kind)
    (suggested,) = re.findall(r"how='(\w+)'", message)
    settings.check_suitable(KINDS_OF_LOOK[suggested].kind)


def test_every_kind_of_look_has_its_object():
    assert list(KINDS_OF_LOOK) == list(get_args(KindName))


def test_a_range_says_what_it_holds():
    assert repr(Range(1, 10)) == "from 1 to 10"
    assert repr(Range(above=0, below=1)) == "above 0 and below 1"
    assert not Range(above=0, below=1).holds(1, whole=False)
    assert Range(0).holds(float("inf"), whole=False)
    assert Range(0).holds(10**400, whole=True)
