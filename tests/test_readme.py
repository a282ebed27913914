"""The README is correct: commands and code run as printed, the targets of links exist, images are small.

Commands run in a temporary folder with the files that they name: PHOTO.jpg, and a data set of one image in COCO
format. The demonstration runs in a new process; the other commands run in this one, where their imports are loaded.
`make` runs only as `--dry-run`, because it sets up an environment, which takes minutes.
"""

import importlib
import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import pytest
import torch
from PIL import Image

import semfov
from semfov.detection.weights import fetch
from tests.colours import SMALL, write_network, write_photographs

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINES = [line for block in re.findall(r"```sh\n(.*?)```", README, re.S) for line in block.splitlines() if line.strip()]
COMMANDS = {line: shlex.split(line, comments=True) for line in LINES}
OWN = [line for line in LINES if "mymodels" in line]
PYTHON = [line for line, words in COMMANDS.items() if words[:2] == ["python", "-m"] and line not in OWN]
PIP = [line for line, words in COMMANDS.items() if words[0] == "pip"]
MAKE = [line for line, words in COMMANDS.items() if words[0] == "make"]
DEMO = next(line for line in PYTHON if "eval.demo" in line)


def test_links_lead_somewhere():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("http")]
    assert len(links) > 5
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_images_are_small():
    for link in re.findall(r"!\[[^]]+\]\(([^)]+)\)", README):
        assert (ROOT / link).stat().st_size < 300_000
        with Image.open(ROOT / link) as picture:
            assert max(picture.size) <= 1000


def test_every_command_is_covered_by_a_test():
    assert set(PYTHON) | set(OWN) | set(MAKE) | set(PIP) == set(LINES)
    assert len(PYTHON) >= 3


def test_pip_installs_only_this_package_and_its_dependencies():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[<>=\[ ]", each)[0] for each in project["dependencies"]} | {project["name"]}
    for line in PIP:
        asked = [word for word in COMMANDS[line][2:] if not word.startswith(("-", "https:")) and word != "."]
        assert {re.split(r"[<>=\[@ ]", word)[0] for word in asked} <= needed


@pytest.mark.slow
def test_the_three_commands_for_a_custom_detector_run(tmp_path, run):
    """As printed, except for a smaller fit and a detector of colours instead of cups."""
    assert [COMMANDS[line][2] for line in OWN] == ["train.fit_detector", "eval.demo", "eval.search"]
    assert all(line in (ROOT / "docs/detectors.md").read_text() for line in OWN)
    write_network(tmp_path / "mine.onnx")
    for name, instances in (("PHOTOS", "instances.json"), ("OTHERS", "others.json")):
        (tmp_path / name).mkdir()
        write_photographs(tmp_path / name).rename(tmp_path / instances)
    Image.open(tmp_path / "OTHERS/3.png").convert("RGB").save(tmp_path / "PHOTO.jpg")
    fit, demo, search = ([word.replace("cup", "red") for word in COMMANDS[line]] for line in OWN)
    assert written_files(run([*fit, *SMALL], tmp_path, tmp_path / "cache"), tmp_path)
    assert "“red”" in run(demo, tmp_path, tmp_path / "cache")
    few = ["--data.min_instances", "0", "--data.limit", "1"]
    assert written_files(run([*search, *few], tmp_path, tmp_path / "cache"), tmp_path)


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("line", MAKE)
def test_make_has_the_target(line):
    dry = subprocess.run([*COMMANDS[line], "--dry-run"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {"search": "-m eval.search", "test": "-m pytest"}[COMMANDS[line][1]] in dry.stdout


def test_programs_named_in_the_text_exist():
    named = set(re.findall(r"python -m ([\w.]+)", README))
    assert len(named) > 5
    assert [name for name in named if importlib.util.find_spec(name) is None] == []


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A cache with only the weights of the default detector."""
    try:
        kept = fetch("yolov3-tiny")
    except semfov.DataError as error:
        pytest.skip(f"the default detector's weights are missing: {error}")
    cache = tmp_path_factory.mktemp("cache")
    (cache / kept.name).symlink_to(kept)
    return cache


def save(image, path):
    pixels = (image * 255).round().to(torch.uint8).permute(1, 2, 0).numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


@pytest.fixture
def folder(tmp_path):
    """A reader's folder: photographs, and one of them as a COCO data set at the path that the README uses."""
    scenes = semfov.EmbeddedScenes(["cup"], count=1)
    for name in ("PHOTO.jpg", "kitchen.jpg", "photographs/PHOTO.jpg"):
        save(scenes[0].image, tmp_path / name)
    film(tmp_path)
    scene, name = scenes[0], "000000000000.jpg"
    save(scene.image, tmp_path / "coco/val2017" / name)
    height, width = scene.image.shape[-2:]
    images = [{"id": 0, "file_name": name, "width": width, "height": height}]
    # The published selection needs this number of boxes.
    boxes = scene.boxes.tolist() + [[20.0 * n, 0.0, 20.0 * n + 15, 15.0] for n in range(8)]
    annotations = [
        {"id": n, "image_id": 0, "category_id": 47, "bbox": [x, y, right - x, bottom - y]}
        for n, (x, y, right, bottom) in enumerate(boxes)
    ]
    content = {"images": images, "annotations": annotations, "categories": [{"id": 47, "name": "cup"}]}
    (tmp_path / "coco/annotations").mkdir()
    (tmp_path / "coco/annotations/instances_val2017.json").write_text(json.dumps(content))
    return tmp_path


def film(folder):
    """A video of two frames."""
    frame = cv2.imread(str(folder / "PHOTO.jpg"))
    writer = cv2.VideoWriter(str(folder / "VIDEO.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 5, frame.shape[1::-1])
    for _ in range(2):
        writer.write(frame)
    writer.release()


@pytest.fixture
def run(monkeypatch, capsys, one_thread):
    """Runs a command in a reader's folder and returns its output."""

    def call(words, folder, cache):
        monkeypatch.chdir(folder)
        monkeypatch.setenv("SEMFOV_CACHE", str(cache))
        try:
            code = importlib.import_module(words[2]).main(words[3:])
        except SystemExit as stopped:
            code = stopped.code
        printed = capsys.readouterr()
        assert code == 0, printed.err
        return printed.out

    return call


def run_in_new_process(words, folder, cache):
    """Like `run`, in a new process where warnings are errors."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "SEMFOV_CACHE": str(cache), "PYTHONWARNINGS": "error"}
    call = [sys.executable, *words[1:]]
    done = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def written_files(printed, folder):
    """The files that a command lists as written, after checking that they exist."""
    names = [line.strip() for line in printed.partition("written:\n")[2].partition("\n\n")[0].splitlines()]
    assert names
    assert [name for name in names if not (folder / name).is_file()] == []
    return names


@pytest.mark.weights
@pytest.mark.slow
@pytest.mark.parametrize("line", PYTHON, ids=lambda line: COMMANDS[line][2])
def test_command_runs_as_printed(line, folder, weights, run):
    words = COMMANDS[line]
    names = written_files((run_in_new_process if line == DEMO else run)(words, folder, weights), folder)
    for option in ("--report", "--out"):
        if option in words:
            asked = words[words.index(option) + 1]
            assert [name for name in names if name.startswith(asked)]


# Further options that the comment after the demonstration's command names.
ALSO = {
    "folder": lambda words: [word.replace("PHOTO.jpg", "photographs") for word in words],
    "explore": lambda words: [*words[: words.index("--target")], "--explore", *words[words.index("--target") + 2 :]],
}


@pytest.mark.weights
@pytest.mark.slow
@pytest.mark.parametrize("other", ALSO)
def test_demonstration_runs_with_the_options_of_its_comment(other, folder, weights, run):
    for word in ("folder", "--explore"):
        assert word in DEMO.partition("#")[2]
    words = ALSO[other](COMMANDS[DEMO])
    printed = run([*words, "--shifts", "2"], folder, weights)
    assert "cup.html" in written_files(printed, folder)
    assert ("explored with 2 gaze shifts" in printed) == (other == "explore")


@pytest.mark.weights
@pytest.mark.slow
def test_help_command_runs(folder, weights, run):
    (line,) = re.findall(r"`(python -m [\w.]+ --help)`", README)
    assert "usage" in run(shlex.split(line), folder, weights)


@pytest.mark.weights
@pytest.mark.slow
def test_code_runs_as_printed(folder, weights, monkeypatch):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len([line for line in code.splitlines() if line]) <= 12
    monkeypatch.chdir(folder)
    monkeypatch.setenv("SEMFOV_CACHE", str(weights))
    names = {}
    exec(compile(code, "README.md", "exec"), names)
    assert names["scanpath"].classes[names["scanpath"].target] == "cup"
    assert 1 <= names["explored"].shifts <= 20
    for name in ("scanpath.pdf", "search.gif", "search.safetensors"):
        assert Path(name).is_file()
    assert Path("map.png").is_file()
