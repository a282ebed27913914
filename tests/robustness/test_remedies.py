"""Every remedy of the tables of words names what is there: attributes, calls with their options, commands."""

import ast
import importlib
import re
from collections.abc import Iterator
from dataclasses import fields
from inspect import Parameter, signature
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

import semfov
from semfov import ActivePerception, FovealObservationModel, Grid, attribute_words, words
from semfov.cli.commands import SUBCOMMANDS
from semfov.cli.main import _option_names
from semfov.cli.options import FindOptions
from semfov.detection.load import loader_options
from semfov.errors import InputError
from semfov.gaze.saliency import FixationDensity
from semfov.paths import GazePrediction
from semfov.words import dashed
from tests import small

PIXELS = np.random.default_rng(0).integers(0, 256, (30, 44, 3), dtype=np.uint8)

ATTRIBUTES = (
    attribute_words.PACKAGE,
    attribute_words.AGENT,
    attribute_words.DECISION,
    attribute_words.LIVE,
    attribute_words.OBJECTS,
    attribute_words.RECORD,
    attribute_words.GAZE_PREDICTION,
    attribute_words.LOOK,
    attribute_words.METRICS,
    attribute_words.MOMENT,
    attribute_words.BELIEF,
    attribute_words.MODEL,
    attribute_words.POLICIES,
)
REMEDIES = {
    *(remedy for table in (*ATTRIBUTES, words._OTHER_PLACES) for remedy in table.values()),
    *(remedy for table in words.ADVICE_OF.values() for remedy in table.values()),
    *words.ADVICE.values(),
    *words._OTHER_METHODS.values(),
    *(f"semfov.{call}" for call in words.MAKERS.values()),
    *(words.other_method("search", option, ()) for option in words._OF_DETECTORS),
    *(f"agent.{call}" for call in re.findall(r"\w+\(.*?\)", words._OF_TARGETS)),
}

OPTIONS = {
    "help",
    "print-config",
    "config",
    *(dashed(name) for command in SUBCOMMANDS for name in _option_names(command)),
}
"""Options of the commands."""

PASSED_ON = {
    "recommended": {*signature(ActivePerception.recommended).parameters, *loader_options()},
    "load_detector": {*loader_options()},
    "run": {setting.name for setting in fields(FindOptions)},
}
"""Options of calls that pass them on."""


@pytest.fixture(scope="module")
def things():
    """What the first names of remedies stand for."""
    agent = small.agent(small.Fixed(("cup", "wine glass")), grid=(4, 3), sigma=10.0, reference=64.0)
    density = FixationDensity({"backbone8": 3}).eval()
    live = agent.live("cup", how="windows")
    observer = agent.searching.observer
    record = agent.search(PIXELS, "cup", how="fovea", shifts=1)
    return {
        "semfov": semfov,
        "agent": agent,
        "record": record,
        "objects": record.objects,
        "decision": record.decision,
        "look": record[0],
        "live": live,
        "moment": live.step(PIXELS),
        "observer": observer,
        "belief": observer.start(1, Grid(4, 3, (44, 30)), torch.zeros(1)),
        "model": FovealObservationModel.identity(["cup"], [0.2]),
        "gaze": GazePrediction(density, {"map": torch.zeros(1, 39, 52)}, (104, 78), torch.zeros(3, 78, 104)),
    }


def expressions(remedy: str, names: object) -> Iterator[ast.expr]:
    """Each expression of a remedy that begins with one of the names; a missing value is an ellipsis."""
    brackets = r"\((?:[^()]|\([^()]*\))*\)|\[[^\]]*\]"
    for match in re.finditer(rf"(?<![\w.`])(?:{'|'.join(names)})(?:\.\w+|{brackets})+", remedy):
        yield ast.parse(re.sub(r"=…?(?=[,)])", "=...", match[0]), mode="eval").body


def value_of(code: ast.expr, things: dict[str, object]) -> object:
    """What an expression stands for; of a call, whose arguments are checked alone, what it is known to return."""
    if isinstance(code, ast.Name):
        return things[code.id]
    if isinstance(code, ast.Attribute):
        return getattr(value_of(code.value, things), code.attr)
    if isinstance(code, ast.Subscript):
        return eval(ast.unparse(code), things)
    assert isinstance(code, ast.Call)
    function = value_of(code.func, things)
    name = ast.unparse(code.func).rpartition(".")[2]
    options = {keyword.arg for keyword in code.keywords}
    if not str(getattr(function, "__module__", None)).startswith("semfov"):  # of tensors and figures
        return callable(function)
    form = signature(function)
    form.bind(*code.args, **dict.fromkeys(options))
    if any(parameter.kind is Parameter.VAR_KEYWORD for parameter in form.parameters.values()):
        assert options <= PASSED_ON.get(name, set())
    known = {"recommended": things["agent"], "live": things["live"], "find_all": things["record"], "plot": Figure}
    return known.get(name)


@pytest.mark.parametrize("remedy", sorted(REMEDIES))
def test_what_a_remedy_names_is_there(remedy, things):
    for statement in re.findall(r"`(from [\w.]+ import .*?)`", remedy):
        exec(statement, {})
    for code in expressions(remedy, things):
        value_of(code, things)
    assert {*re.findall(r"`semfov (\w+)", remedy)} <= {*SUBCOMMANDS}
    assert {*re.findall(r"--([a-z-]+)", remedy)} <= OPTIONS


@pytest.mark.parametrize(
    ("thing", "word", "remedy"),
    [
        ("agent", "heat_map", "agent.gaze(picture)"),
        ("agent", "analyze", "search, find_all, explore"),
        ("record", "stop_reason", "record.why_it_ended()"),
        ("record", "num_looks", "len(record)"),
        ("gaze", "hotspots", "gaze.peaks()"),
        ("gaze", "aois", "gaze.share(areas)"),
        ("agent", "reset", "an agent keeps nothing of earlier pictures"),
        ("record", "masks", "the detector has no masks"),
        ("objects", "sort", "objects[objects.scores.argsort(descending=True)]"),
        ("gaze", "diff", "semfov.paths.Drafts(gaze, other)"),
        ("look", "boxes", "look.detections; record.objects has those of all looks together"),
        ("gaze", "find", "agent.find_all(picture, target)"),
        ("agent", "compare", "semfov.paths.Drafts(agent.gaze(first), agent.gaze(second))"),
        ("model", "num_classes", "len(model.classes)"),
        ("semfov", "Fovea", "semfov.Foveation"),
        ("semfov", "nn", "semfov.observers"),
        ("semfov", "PanTiltCamera", "semfov.head.PanTiltCamera"),
        ("record", "save_video", "use save"),
        ("record", "to_coco_annotations", "use to_coco"),
        ("objects", "get_scores", "use objects.scores"),
    ],
)
def test_words_of_others_are_answered_with_ours(thing, word, remedy, things):
    with pytest.raises(AttributeError, match=re.escape(remedy)):
        getattr(things[thing], word)


@pytest.mark.parametrize(
    ("method", "option", "remedy"),
    [
        ("gaze", "viewers", "gaze.scanpaths(people, seconds=…)"),
        ("gaze", "aoi", "gaze.share(areas)"),
        ("search", "policy", "explore takes one"),
        ("find_all", "mask", "what is transparent in a picture is left out"),
        ("find_all", "resume", "semfov.run(pictures, target, out=FILE)"),
        ("find_all", "slice_height", "semfov chooses the windows"),
        ("search", "return_heatmap", "record.belief_map(-1)"),
        ("search", "max_fixations", "did you mean shifts= or passes=?"),
        ("search", "prior_odds", "did you mean prior=?"),
        ("live", "stream", "live.step(frame) takes the frames"),
    ],
)
def test_options_of_others_are_answered_with_ours(method, option, remedy, things):
    with pytest.raises(InputError, match=re.escape(remedy)):
        getattr(things["agent"], method)(PIXELS, **{option: 1})


@pytest.mark.parametrize("make", [ActivePerception.recommended, ActivePerception.published, ActivePerception.raw])
def test_a_detector_is_the_name_that_an_agent_is_made_from(make):
    with pytest.raises(InputError, match="did you mean name="):
        make(detector="yolox-nano")


def test_names_of_policies_and_arguments_of_scenes_are_told():
    with pytest.raises(AttributeError, match=re.escape("use semfov.policies.policy_names(task)")):
        _ = semfov.policies.names
    with pytest.raises(InputError, match="'classes'; expected root, annotations, classes"):
        semfov.CocoScenes("photographs", "instances.json")


@pytest.mark.parametrize(
    ("word", "parts"),
    [
        ("conf", []),
        ("confidence_threshold", ["threshold", "confidence"]),
        ("save_paths", ["save", "paths"]),
        ("n_max_fixations", ["max_fixations", "fixations", "n_max"]),
        ("ignore_classes", ["ignore", "classes"]),
        ("no_save", []),
    ],
)
def test_the_head_of_a_word_of_several_parts_comes_first(word, parts):
    assert words.parts_of(word) == [form for part in parts for form in (part, f"{part}s", part.removesuffix("s"))]


def test_measures_are_in_the_modules_that_are_named():
    for name in ("nss", "multimatch", "calibration_error", "area_under_roc"):
        with pytest.raises(AttributeError, match=attribute_words.METRICS[name]):
            getattr(semfov.metrics, name)
        assert hasattr(importlib.import_module(attribute_words.METRICS[name]), name)


def test_the_modules_of_measures_need_no_import_of_their_own(fresh):
    assert fresh("import semfov; print(semfov.metrics.scanpath.nss.__name__)") == "nss\n"
    modules = {path.stem for path in Path(semfov.metrics.__path__[0]).glob("[!_]*.py")}
    assert {*dir(semfov.metrics)} == modules


def test_remedies_are_read():
    """So that the test above cannot pass because nothing is found in them."""
    roots = ("semfov", "agent", "record", "objects", "decision", "look", "live", "gaze", "belief", "model", "moment")
    named = re.compile(r"`|--[a-z]")
    silent = [remedy for remedy in REMEDIES if not named.search(remedy) and not [*expressions(remedy, roots)]]
    assert len(silent) < 26 < len(REMEDIES) - 50


def test_sizes_of_objects_are_those_that_the_remedy_computes():
    code = attribute_words.OBJECTS["xywh"].rpartition(": ")[2].removesuffix(" are their sizes")
    objects = small.agent(small.Fixed(("cup",)), grid=(4, 3), sigma=10.0).find_all(PIXELS, "cup").candidates
    for (x1, y1, x2, y2), (width, height) in zip(objects.boxes.tolist(), eval(code, {"objects": objects}), strict=True):
        assert (float(width), float(height)) == pytest.approx((x2 - x1, y2 - y1))


def test_remedies_of_attributes_complete_the_sentence():
    """They follow the word "use"."""
    assert [remedy for table in ATTRIBUTES for remedy in table.values() if re.match(r"leave|use|is\b", remedy)] == []
