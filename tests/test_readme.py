"""The README is correct: commands and code run as printed, the targets of links exist, images are small.

Commands run in a temporary folder with the files that they name: a photograph, a large picture, a panorama, a video,
and data sets in COCO format. `make` runs only as `--dry-run`, because it sets up an environment, which takes minutes.
"""

import importlib
import importlib.util
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from PIL import Image

import semfov
from semfov.cli.main import main as semfov_command
from semfov.detection.weights import fetch
from tests.colours import SMALL, write_network, write_photographs
from tests.small import once

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
LINES = [line for block in re.findall(r"```sh\n(.*?)```", README, re.S) for line in block.splitlines() if line.strip()]
COMMANDS = {line: shlex.split(line, comments=True) for line in LINES}
OWN = [line for line in LINES if "mymodels" in line]
SEMFOV = [line for line, words in COMMANDS.items() if words[0] == "semfov" and line not in OWN]
PIP = [line for line, words in COMMANDS.items() if words[0] == "pip"]
MAKE = [line for line, words in COMMANDS.items() if words[0] == "make"]


def test_links_lead_somewhere():
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if not link.startswith("http")]
    assert len(links) > 5
    for link in links:
        file, _, heading = link.partition("#")
        assert (ROOT / file).exists(), link
        if heading:
            titles = re.findall(r"^#+ (.+)$", (ROOT / file).read_text(encoding="utf-8"), re.M)
            assert heading in [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles], link


def test_it_is_short_and_so_are_its_images():
    assert len(README.splitlines()) <= 150
    for link in re.findall(r"!\[[^]]+\]\(([^)]+)\)", README):
        assert (ROOT / link).stat().st_size < 300_000
        with Image.open(ROOT / link) as picture:
            assert max(picture.size) <= 1000


def test_pip_installs_only_this_package_and_its_dependencies():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needed = {re.split(r"[<>=\[ ]", each)[0] for each in project["dependencies"]} | {project["name"]}
    for line in PIP:
        asked = [word for word in COMMANDS[line][2:] if not word.startswith(("-", "https:")) and word != "."]
        assert {re.split(r"[<>=\[@ ]", word)[0] for word in asked} <= needed


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
@pytest.mark.parametrize("line", MAKE)
def test_make_has_the_target(line):
    dry = subprocess.run([*COMMANDS[line], "--dry-run"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {"search": "-m eval.search", "test": "-m pytest"}[COMMANDS[line][1]] in dry.stdout


def test_commands_are_covered_and_programs_exist():
    assert set(SEMFOV) | set(OWN) | set(MAKE) | set(PIP) == set(LINES)
    assert len(SEMFOV) >= 3
    named = set(re.findall(r"python -m ([\w.]+)", README))
    assert len(named) > 2
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


@pytest.fixture
def given(tmp_path, monkeypatch, weights, reader):
    """What code of a reader takes as given; the present folder is a copy of the reader's."""
    filled, given = reader
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SEMFOV_CACHE", str(weights))
    return given


@pytest.fixture
def folder(given, tmp_path):
    """A reader's folder."""
    return tmp_path


@pytest.fixture
def run(capsys, one_thread):
    """Runs a command in the present folder, and returns its output."""

    def call(words):
        command = semfov_command if words[0] == "semfov" else importlib.import_module(words[2]).main
        try:
            code = command(words[1:] if words[0] == "semfov" else words[3:])
        except SystemExit as stopped:
            code = stopped.code
        printed = capsys.readouterr()
        assert not code, printed.err
        return printed.out

    return call


def written_files(printed):
    """The files that a command lists as written, after checking that they exist."""
    names = [line.strip() for line in printed.partition("written:\n")[2].partition("\n\n")[0].splitlines()]
    assert names
    assert [name for name in names if not Path(name).is_file()] == []
    return names


@pytest.mark.weights
@pytest.mark.slow
@pytest.mark.parametrize("line", SEMFOV)
def test_command_runs_as_printed(line, folder, run):
    words = COMMANDS[line]
    printed = run(words)
    assert words[words.index("--target") + 1] in printed
    for option in ("--report", "--out"):
        if option in words:
            asked = words[words.index(option) + 1]
            assert [name for name in written_files(printed) if name.startswith(asked)]


@pytest.mark.slow
@pytest.mark.lab
def test_the_three_commands_for_a_custom_detector_run(folder, run):
    """As printed, except for a tiny fit and a detector of colours instead of cups; and the study of a checkout."""
    page = (ROOT / "docs/detectors.md").read_text(encoding="utf-8")
    assert all(line in page for line in OWN)
    (study,) = (line.split() for line in page.splitlines() if line.startswith("python -m eval.search --models"))
    write_network(folder / "mine.onnx")
    for name, instances in (("PHOTOS", "instances.json"), ("OTHERS", "others.json")):
        (folder / name).mkdir()
        write_photographs(folder / name).rename(folder / instances)
    fit, find, search = ([word.replace("cup", "red") for word in COMMANDS[line]] for line in OWN)
    tiny = [*SMALL, *["--data.limit", "6", "--holdout", "3", "--steps", "3", "--map_steps", "3", "--fixations", "2"]]
    assert written_files(run(once([*fit, *tiny])))
    assert "red" in run(find)
    assert "red" in run(search)
    task = (ROOT / "docs/tasks/own-detector.md").read_text(encoding="utf-8")
    assert all(line in task for line in OWN)
    (block,) = re.findall(r"```python\n(.*?)```", task, re.S)
    exec(compile(block, "own-detector.md", "exec"), {})
    assert written_files(run(once([*study, "--data.min_instances", "0", "--data.limit", "1"])))


@pytest.mark.weights
@pytest.mark.slow
def test_code_runs_as_printed(given, capsys):
    """The blocks in their order, with frames of the video and with a file of people's fixations."""
    names = dict(given)
    blocks = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(blocks) >= 5
    for block in blocks:
        assert len([line for line in block.splitlines() if line]) <= 5
        exec(compile(block, "README.md", "exec"), names)
    assert {each.target for each in names["people"]} == {"cup"}
    assert "sequence score" in capsys.readouterr().out
    for name in ("cup.html", "people.png"):
        assert Path(name).is_file()
