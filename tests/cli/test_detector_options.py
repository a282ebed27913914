"""Options of detectors in every command that takes one: heads, names, colours, what is remembered, and a trial."""

import ast
import json
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import semfov
from semfov import load_detector
from semfov.cli.commands import SUBCOMMANDS
from semfov.cli.main import _in_command_words, _message_options, _option_names, main
from semfov.cli.options import DetectorOptions
from semfov.detection.load import loader_options
from semfov.detection.onnx_file import names_beside
from semfov.io.compatibility import NETWORKS
from semfov.words import dashed
from tests.refusals import refused
from tests.small import write_network

SIDE = 64
WITH_DETECTOR = [name for name in SUBCOMMANDS if name not in ("check", "demo")]
HERE = Path(semfov.__file__).parent


def columns(names: int = 3, shown: tuple[float, ...] = (0.9, 0.85, 0.02)) -> np.ndarray:
    """Columns of YOLOv8 `(1, 4 + K, 84)` with one box, in the middle of the canvas."""
    found = np.zeros((1, 4 + names, 84), np.float32)
    found[0, :4, 20] = 32, 32, 24, 24
    found[0, 4:, 20] = shown
    return found


@pytest.fixture
def network(tmp_path):
    """Writes a detector whose scores are given ones times a number that the picture's channels give."""
    from onnx import helper

    def write(values: np.ndarray, *, red: float = 0.0, name: str = "mine.onnx", **more) -> Path:
        # 1 − red · (1 − red channel): of a red picture all scores are whole, of a blue one they are smaller.
        weights = np.zeros((1, 3, 1, 1), np.float32)
        weights[0, 0] = red
        steps = [
            helper.make_node("ReduceMean", ["images"], ["colour"], axes=[2, 3], keepdims=1),
            helper.make_node("Conv", ["colour", "weights"], ["part"]),
            helper.make_node("Sub", ["part", "red"], ["less"]),
            helper.make_node("Add", ["less", "one"], ["gain"]),
            helper.make_node("Squeeze", ["gain", "last"], ["factor"]),
            helper.make_node("Mul", ["scores", "factor"], ["scaled"]),
            helper.make_node("Concat", ["boxes", "scaled"], ["output0"], axis=1),
        ]
        stored = {
            "weights": weights,
            "red": np.float32(red),
            "one": np.float32(1),
            "last": np.array([3]),
            "boxes": values[:, :4],
            "scores": values[:, 4:],
        }
        path = tmp_path / name
        write_network(path, steps, {"images": [1, 3, SIDE, SIDE]}, {"output0": list(values.shape)}, stored, **more)
        return path

    return write


def photo(folder: Path, colour: tuple[int, int, int] = (128, 128, 128)) -> Path:
    Image.new("RGB", (SIDE, SIDE), colour).save(folder / "photo.png")
    return folder / "photo.png"


@pytest.mark.parametrize("command", WITH_DETECTOR)
def test_every_command_that_takes_a_detector_has_its_options(command):
    names = {name.rpartition(".")[2] for name in _message_options(command)}
    own = {field.name for field in fields(DetectorOptions)} - {"detector", "remember", "device"}
    assert own <= names
    assert command == "fit" or "remember" in names


def test_settings_are_remembered_beside_the_file(network, tmp_path, capsys):
    path = network(columns())
    words = ["--head", "yolov8", "--classes", "vehicle,car,taxi", "--colour", "bgr", "--per-class"]
    assert main(["detectors", str(path), *words, "--remember"]) == 0
    assert f"wrote {path.with_suffix('.json')}" in capsys.readouterr().out
    stored = json.loads(path.with_suffix(".json").read_text())
    assert stored == {
        "classes": ["vehicle", "car", "taxi"],
        "per_class": True,
        "head": "yolov8",
        "preprocessing": {"channels": "bgr"},
    }
    detector = load_detector(path)
    assert (detector.classes, detector.head) == (("vehicle", "car", "taxi"), "yolov8")
    assert (detector.preprocessing.channels, detector.selection.per_class) == ("bgr", True)
    assert load_detector(path, per_class=False).selection.per_class is False
    assert main(["find", str(photo(tmp_path)), "--detector", str(path), "--agent", "raw", "--passes", "1"]) == 0
    assert "vehicle 0.90" in capsys.readouterr().out


@pytest.mark.parametrize("command", ["search", "find", "explore", "gaze", "detectors"])
def test_settings_of_onnx_files_are_refused_for_other_detectors(command, tmp_path, capsys):
    detector = ["yolov3-tiny"] if command == "detectors" else [str(photo(tmp_path)), "--detector", "yolov3-tiny"]
    target = ["--target", "cup"] if command == "search" else []
    for words in (["--head", "yolov8"], ["--colour", "bgr"], ["--remember"]):
        assert main([command, *detector, *target, *words]) == 1
        assert "none for a detector that is no ONNX file, got yolov3-tiny" in capsys.readouterr().err


NAMES = ("vehicle", "car", "taxi")


@pytest.mark.parametrize(
    ("metadata", "beside"),
    [
        ({"names": "{0: 'vehicle', 1: 'car', 2: 'taxi'}"}, {}),
        ({"class_names": '["vehicle", "car", "taxi"]'}, {}),
        ({"labels": "vehicle,car, taxi"}, {}),
        ({"character": "vehicle\ncar\ntaxi\n"}, {}),
        ({}, {"data.yaml": "path: here\nnames:\n  0: vehicle\n  1: car\n  2: taxi\n"}),
        ({}, {"data.yaml": "nc: 3\nnames: [vehicle, car, taxi]\n"}),
        ({}, {"data.yml": "names: [vehicle, car, taxi]\n"}),
        ({}, {"classes.txt": "vehicle\ncar\ntaxi\n"}),
        ({}, {"classes.txt": "\ufeff0: vehicle\r\n1: car\r\n2: taxi\r\n"}),
        ({}, {"labels.txt": "1 vehicle\n2 car\n3 taxi"}),
        ({}, {"classes.txt": "background\nvehicle\ncar\ntaxi\n"}),
        ({}, {"obj.names": "vehicle\ncar\ntaxi\n"}),
        ({}, {"config.json": '{"id2label": {"0": "vehicle", "1": "car", "2": "taxi"}}'}),
        ({}, {"config.json": '{\n\t"id2label": {"0": "vehicle", "1": "car", "2": "taxi"}}'}),
        ({}, {"data.yaml": "names: [cat, dog, ~]", "classes.txt": "0=vehicle\n1=car\n2=taxi"}),
        ({}, {"data.yaml": "names: [cat, dog]", "mine.json": '{"classes": ["vehicle", "car", "taxi"]}'}),
    ],
)
def test_names_are_found_in_the_metadata_and_beside_the_file(metadata, beside, network, tmp_path):
    for name, text in beside.items():
        (tmp_path / name).write_text(text)
    assert load_detector(network(columns(), metadata=metadata), head="yolov8").classes == NAMES


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("1 euro\n2 euro\n", ["1 euro", "2 euro"]),
        ("1 euro\n2 euro\n3 euro\n", ["1 euro", "2 euro", "3 euro"]),
        ("1 person\n", ["1 person"]),
        ("0: person\n", ["person"]),
        ("1 , cat\n2,dog\n", ["cat", "dog"]),
        ("1 cat\n2 dog\n5 cup\n", ["1 cat", "2 dog", "5 cup"]),
        ("0 cat\n1 dog\n2 3 cups\n", ["cat", "dog", "3 cups"]),
    ],
)
def test_a_number_before_a_name_is_left_out_where_it_counts_the_lines(text, names, tmp_path):
    (tmp_path / "classes.txt").write_text(text)
    assert names_beside(tmp_path / "mine.onnx") == names


def test_names_beside_the_file_that_are_too_many_are_counted(network, tmp_path):
    (tmp_path / "classes.txt").write_text("# my classes\nvehicle\ncar\ntaxi\n")
    refused(
        "classes: expected the names of the 3 classes .* got 4 names in",
        load_detector,
        network(columns()),
        head="yolov8",
    )


def test_a_trial_shows_the_bare_scores_beside_those_that_are_listed(network, tmp_path, capsys):
    path = network(columns())
    words = ["--classes", "vehicle,car,taxi", "--head", "yolov8", "--try", str(photo(tmp_path))]
    assert main(["detectors", str(path), *words]) == 0
    printed = capsys.readouterr().out
    assert "shows 1 from 0.3 on, and semfov lists 1 of them" in printed
    assert re.search(r"vehicle +0\.90 +0\.90 +20,20–44,44", printed)
    assert "colours rgb" in printed
    assert "note" not in printed


def test_a_trial_says_what_is_lost(network, tmp_path, capsys):
    """Colours in the other order, scores that an export to int8 has lost, and shares of many small scores."""
    words = ["--head", "yolov8", "--try", str(photo(tmp_path, (0, 0, 255)))]
    colours = network(columns(), red=0.6, name="colours.onnx")
    assert main(["detectors", str(colours), "--classes", "vehicle,car,taxi", *words]) == 0
    assert "note: with --colour bgr it shows 1 from 0.3 on" in capsys.readouterr().out
    lost = network(
        np.concatenate([columns()[:, :4], np.zeros((1, 3, 84), np.float32)], 1).repeat(2, 2), name="int8.onnx"
    )
    assert main(["detectors", str(lost), "--classes", "vehicle,car,taxi", *words]) == 0
    assert "its 168 boxes have 1 different score: an export to int8" in capsys.readouterr().out
    many = network(columns(80, (0.9, *[0.05] * 79)), name="many.onnx")
    assert main(["detectors", str(many), *words]) == 0
    assert "the best class has 0.17 of 0.90" in capsys.readouterr().out


def test_the_colours_of_a_known_network_are_not_doubted(network, tmp_path, capsys, monkeypatch):
    path = network(columns(), red=0.6)
    words = ["detectors", str(path), "--classes", "vehicle,car,taxi", "--head", "yolov8"]
    words += ["--try", str(photo(tmp_path, (0, 0, 255)))]
    monkeypatch.setitem(NETWORKS, load_detector(path, head="yolov8", classes=NAMES).digest, "mine")
    assert main(words) == 0
    assert "note" not in capsys.readouterr().out


def messages(path: Path) -> Iterator[str]:
    """Texts of a module that are no docstrings; values in them are an ellipsis."""
    tree, inside = ast.parse(path.read_text()), set[int]()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            inside.add(id(node.body[0].value))
        if isinstance(node, ast.JoinedStr):
            inside |= {id(part) for part in node.values}
            yield "".join(part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in inside:
            yield node.value


PRINTED_BY = {
    "detection": WITH_DETECTOR,
    "cli/trial.py": ["detectors"],
    "cli/detectors.py": ["search", "find", "explore", "live", "app"],  # the commands that its list names
    "cli/agent.py": ["search", "find", "explore", "live"],
    "cli/search.py": ["search", "find", "explore"],
    "cli/jobs.py": ["search", "find", "explore"],
    "cli/formats.py": ["find"],
    "cli/compare.py": ["compare"],
    "cli/outcome.py": ["search", "find", "explore"],
    "cli/live.py": ["live"],
    "human/check.py": ["check"],
    "cli/sources.py": ["search", "find", "explore", "gaze"],
    "model_folder.py": ["search", "find", "explore", "live", "app"],
    "paths/cautions.py": ["gaze"],
    "runs/workers.py": ["search", "find", "explore", "fit"],
}
"""Commands that can print the messages of a file, or of the files of a folder."""

CONDITIONAL = {
    "--target cup, got none": ["search"],
    "a description needs --embeddings": ["search"],
    "a class is given by --target": ["search", "find"],
}
"""Messages that only some of these commands print."""

HELP = ("cli/commands.py", "cli/app.py")
"""Files with texts of help, which `test_words` reads, and with style sheets, which have variables of their own."""

OTHER_PROGRAMS = {
    "detection/export.py": "a command of its own",
    "detection/weights.py": "pip",
}


def remedies() -> Iterator[tuple[str, str, str]]:
    """Every message that names an option, with its file and a command that can print it."""
    for place, commands in PRINTED_BY.items():
        files = sorted((HERE / place).rglob("*.py")) if (HERE / place).is_dir() else [HERE / place]
        for file in files:
            name = file.relative_to(HERE).as_posix()
            for text in messages(file) if name not in OTHER_PROGRAMS else ():
                only = next((some for words, some in CONDITIONAL.items() if words in text), commands)
                for command in only:
                    told = _in_command_words(text, _message_options(command))
                    # A whole command in a message may be another one.
                    for other, words in re.findall(r"`semfov (\w+)([^`]*)`", told):
                        yield name, other, words
                    yield name, command, re.sub(r"`semfov [^`]*`", "", told)


def test_every_remedy_of_a_message_exists_in_the_command_that_prints_it():
    options, wrong, seen = "|".join({*loader_options(), "detector"}), [], 0
    for name, command, text in remedies():
        known = {dashed(option) for option in (*_message_options(command), "try")}
        for option in re.findall(r"(?<![\w-])--([a-z][a-z._-]*[a-z])", text):
            seen += 1
            if option not in known:
                wrong.append((name, command, f"--{option}", text[:90]))
        # What is still said as Python says it is an option of loading that the command has not.
        wrong += [(name, command, left, text[:90]) for left in re.findall(rf"(?<![\w.])(?:{options})=", text)]
    assert wrong == []
    assert seen > 50


def test_every_option_that_any_message_names_is_one_of_some_command():
    known = {dashed(option) for command in SUBCOMMANDS for option in _option_names(command)}
    # Those of a fit are dotted, and `test_words` checks the ones of its help.
    known |= set(re.findall(r"--([a-z][a-z._]*)", SUBCOMMANDS["fit"].help))
    known |= {"config", "help", "help-all", "help_all", "print-config", "version"}
    unknown = []
    for file in sorted(HERE.rglob("*.py")):
        name = file.relative_to(HERE).as_posix()
        # To parse a module takes long, and most name no option.
        if name in OTHER_PROGRAMS or name in HELP or not re.search("--[a-z]", file.read_text()):
            continue
        for text in messages(file):
            options = re.findall(r"(?<![\w-])--([a-z][a-z._-]*[a-z])", text)
            unknown += [(name, option, text[:90]) for option in options if option not in known]
    assert unknown == []
