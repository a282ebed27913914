"""README, guides and pages by task run as printed; the reference and docs/method.md have all that they list."""

import importlib
import importlib.util
import inspect
import logging
import os
import re
import shlex
import shutil
import subprocess
import tomllib
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from PIL import Image

import semfov
from docs.api import entries, pages
from eval.figures import _FIGURES
from eval.page.figures import PAGE_FIGURES
from semfov.cli.main import main
from semfov.cli.main import main as semfov_command
from tests.colours import SMALL, write_network, write_photographs
from tests.small import once

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = [*sorted(DOCS.glob("guides/*.md")), DOCS / "pan-tilt.md"]
PAGES = [DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


@pytest.mark.filterwarnings("ignore:levels with fewer than")
@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_guides_run(guide, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", guide.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(block, guide.name, "exec"), namespace)


@pytest.mark.parametrize("kind", ["policy", "observer", "sensor"])
def test_guides_for_custom_parts_show_the_part_of_the_example(kind):
    """The whole example up to the program that tries the part."""
    example = (DOCS.parent / "examples" / f"own_{kind}.py").read_text(encoding="utf-8")
    part, _, program = example.partition("\n\n\ndef main(")
    assert program
    assert f"```python\n{part}\n```" in (DOCS / "guides" / f"write_your_own_{kind}.md").read_text(encoding="utf-8")


def test_the_reference_has_no_local_paths_and_a_guide_for_each_subpackage():
    rooms = {"sensor", "detection", "observation", "belief", "gaze", "evaluation"}
    assert {guide.stem for guide in GUIDES} >= rooms
    # It contains neither memory addresses of objects nor the path of the checkout.
    text = "\n".join(pages().values())
    assert not re.search(r"0x[0-9a-f]{6}| at 0x", text)
    assert str(DOCS.parent) not in text


def test_the_reference_contains_every_public_name_of_the_package():
    explained = {id(value) for entries_of_module in entries().values() for _, value in entries_of_module}
    names = [semfov, *(value for value in vars(semfov).values() if inspect.ismodule(value) and value is not semfov)]
    for module in names:
        if module.__name__ != "semfov" and module.__name__.split(".")[-1] not in semfov.__all__:
            continue
        public = getattr(module, "__all__", None) or []
        for name in public:
            value = getattr(module, name)
            if inspect.isclass(value) or inspect.isfunction(value):
                assert id(value) in explained, f"{module.__name__}.{name}"


FILES = re.compile(r"`((?:semfov|eval|train|docs|tests|examples|benchmarks|configs)(?:/[\w.*]+)*|mkdocs\.yml)/?`")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS.parent).as_posix())
def test_files_named_on_a_page_exist(page):
    named = set(FILES.findall(page.read_text(encoding="utf-8")))
    assert named or page.stem != "map"
    assert [name for name in sorted(named) if not list(DOCS.parent.glob(name))] == []


def test_names_on_the_map_stand_in_their_files():
    """A row such as `follow` of `semfov/tracking/tracker.py` names what its file defines."""
    text = (DOCS / "map.md").read_text(encoding="utf-8")
    named = re.findall(r"((?:`\w+`(?:, | and )?)+) of `([\w/]+\.py)`", text)
    pairs = [(name, file) for names, file in named for name in re.findall(r"\w+", names.replace(" and ", " "))]
    sources = {file: (DOCS.parent / file).read_text(encoding="utf-8") for _, file in pairs}
    assert len(pairs) > 5
    definition = r"(?m)^\s*(?:def|class) {0}\b|^{0}\b.*=|^\s+{0}:"  # also of an attribute
    assert [pair for pair in pairs if not re.search(definition.format(pair[0]), sources[pair[1]])] == []


def test_the_map_names_every_room():
    """Every folder and module of the package is in the map, except for the version and the errors."""
    text = (DOCS / "map.md").read_text(encoding="utf-8")
    rooms = {
        path.relative_to(DOCS.parent).with_suffix("").as_posix() for path in Path(semfov.__file__).parent.glob("[a-z]*")
    }
    without = {"semfov/version", "semfov/errors", "semfov/py"}
    assert [room for room in sorted(rooms - without) if f"`{room}" not in text] == []


ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
ROWS = [line for line in PAGE.splitlines() if line.startswith("| ") and "`" in line]
SYMBOLS = sorted({name for row in ROWS for name in re.findall(r"`((?:semfov|eval|train)[\w.]*)", row.split("|")[-2])})
PAPER = Path(os.environ.get("SEMFOV_SHARED", ROOT.parent / "shared")) / "paper.tex"

EQUATIONS = [
    "scores", "semanticmap", "betamap", "finalsemanticmap", None, "confscores", "kaplanrule", "bayesrule", "dirichlet",
    "alphas_fom", "corrected_scores", "peaks_nonpred", "predbeta", "probpred", "proportional", "expected_operator",
    "local_scores", "peaks_pred", "kldivergence", "entropy", "minimize", "twopeaks", "maximize",
]  # fmt: skip
"""Labels of the paper's numbered equations; one has none."""

DRAWN = [
    "detection_example", "foveal_reconstruction", "attention", "general", "map", "bayesnet", "ambiguities",
    "grid_example", "saliency_example", "cum1", "vsexample", "cum2", "acfuncs", "expres",
]  # fmt: skip
"""Labels of the paper's figures."""


def rows_of(heading):
    """The rows of the table of a section, as lists of cells."""
    section = PAGE.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    rows = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [[cell.strip() for cell in row.split(" | ")] for row in (row.strip("| ") for row in rows)]


def labels_of(equations):
    """Label of every number that LaTeX gives to the equations of a text; None for a number without a label."""
    found = []
    for kind, body in re.findall(r"\\begin\{(equation|align)\}(.*?)\\end\{\1\}", equations, re.DOTALL):
        lines = re.split(r"\\\\", body) if kind == "align" and "{split}" not in body else [body]
        for line in lines:
            label = re.search(r"\\label\{eq:(\w+)\}", line)
            found.append(label and label[1])
    return found


@pytest.mark.parametrize("symbol", SYMBOLS)
def test_symbol_of_the_page_exists(symbol):
    parts = symbol.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for name in parts[length:]:
            found = getattr(found, name)
        return
    pytest.fail(f"{symbol} does not exist")


def test_every_equation_and_figure_of_the_paper_is_listed_with_its_code_or_the_reason_for_none():
    rows = rows_of("The paper's equations")
    assert [int(number) for number, *_ in rows] == list(range(1, len(EQUATIONS) + 1))
    assert [None if label == "without a label" else label.strip("`") for _, label, *_ in rows] == EQUATIONS
    assert [row for row in rows if not re.match(r"`semfov\.|none: ", row[-1])] == []
    assert len(ROWS) > 50
    assert len(SYMBOLS) > 40
    cited = {int(number) for group in re.findall(r"\((\d+(?:, \d+)*)\) \|", PAGE) for number in group.split(", ")}
    assert len(cited) > 10
    assert max(cited) <= len(EQUATIONS)
    rows = rows_of("The paper's figures")
    commands = {label.strip("`"): command for label, _, command in rows}
    assert list(commands) == DRAWN
    assert [label for label, command in commands.items() if command == "`python -m eval.figures`"] == list(_FIGURES)
    linked = re.findall(r"pictures/(\w+)\.png", "\n".join(shown for _, shown, _ in rows))
    assert linked == list(PAGE_FIGURES)
    assert [command for command in commands.values() if not re.match(r"`python -m |none: ", command)] == []


@pytest.mark.skipif(not PAPER.exists(), reason=f"{PAPER} is missing")
def test_the_lists_are_those_of_the_paper():
    text = PAPER.read_text(encoding="utf-8")
    assert labels_of(text) == EQUATIONS
    figures = re.findall(r"\\begin\{figure\*?\}(.*?)\\end\{figure", text, re.DOTALL)
    assert [re.findall(r"\\label\{fig:(\w+)\}", figure)[-1] for figure in figures] == DRAWN


README = (ROOT / "README.md").read_text(encoding="utf-8")
LINES = [line for block in re.findall(r"```sh\n(.*?)```", README, re.S) for line in block.splitlines() if line.strip()]
LINES += [line for line in re.findall(r"^\|.*\| `(semfov [^`]+)` \|$", README, re.M) if line not in LINES]
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
    assert len(README.splitlines()) <= 110
    cells = [cell for line in README.splitlines() if line.startswith("|") for cell in line.split("|")]
    assert [cell for cell in cells if len(cell.strip()) > 120] == []
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
def cache(tmp_path_factory):
    """An empty cache: the default detector is in the package."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def given(tmp_path, monkeypatch, cache, reader):
    """What code of a reader takes as given; the present folder is a copy of the reader's."""
    filled, given = reader
    shutil.copytree(filled, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SEMFOV_CACHE", str(cache))
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
    names = re.findall(r"^  (.+)$", printed.partition("written:\n")[2].partition("\n\n")[0], re.M)
    assert names
    assert [name for name in names if not Path(name).is_file()] == []
    return names


@pytest.mark.slow
@pytest.mark.parametrize("line", [line for line in SEMFOV if COMMANDS[line][1] != "demo"])  # `cli/test_demo` runs it
def test_command_runs_as_printed(line, folder, run):
    words = COMMANDS[line]
    printed = run(words)
    if "--target" in words:
        assert words[words.index("--target") + 1] in printed
    for option in ("--report", "--out"):
        if option in words:
            asked = words[words.index(option) + 1]
            assert [name for name in written_files(printed) if name.startswith(asked)]


@pytest.mark.slow
@pytest.mark.lab
def test_the_commands_for_a_custom_detector_run(folder, run):
    """As printed, except for a tiny fit and a detector of colours instead of cups; and the study of a checkout."""
    page = (ROOT / "docs/detectors.md").read_text(encoding="utf-8")
    (study,) = (line.split() for line in page.splitlines() if line.startswith("python -m eval.search --models"))
    write_network(folder / "mine.onnx")
    for name, instances in (("PHOTOS", "instances.json"), ("OTHERS", "others.json")):
        (folder / name).mkdir()
        write_photographs(folder / name).rename(folder / instances)
    fit, *looks = ([word.replace("cup", "red") for word in COMMANDS[line]] for line in OWN)
    tiny = [*SMALL, *["--data.limit", "6", "--holdout", "3", "--steps", "3", "--fixations", "2"]]
    assert written_files(run(once([*fit, *tiny])))
    assert len(looks) >= 1
    for words in looks:
        assert "red" in run(words)
    task = (ROOT / "docs/tasks/own-detector.md").read_text(encoding="utf-8")
    assert all(line in task for line in OWN)
    (block,) = re.findall(r"```python\n(.*?)```", task, re.S)
    exec(compile(block, "own-detector.md", "exec"), {})
    assert written_files(run(once([*study, "--data.min_instances", "0", "--data.limit", "1"])))


@pytest.mark.slow
def test_code_runs_as_printed(given, capsys):
    """The blocks in their order, with frames of the video."""
    names = dict(given)
    blocks = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(blocks) >= 2
    for block in blocks:
        assert len([line for line in block.splitlines() if line]) <= 8
        exec(compile(block, "README.md", "exec"), names)
    assert names["record"].target_name == "cup"
    assert "cup: " in capsys.readouterr().out


TASKS = Path(__file__).parents[1] / "docs" / "tasks"
TASK_PAGES = sorted(TASKS.glob("*.md"))
SHORTER = {
    "yolov3-tiny|nanodet-plus-m-1.5x": "yolox-nano",
    "(?<=passes[= ])16": "3",
    "(?<=shifts=)(5|10)": "2",
    "(?<=duration=)10": "3",
    "(?<=--gaze.seconds 5)": " --gaze.folds 2 --gaze.fit.epochs 2 --gaze.fit.saccade_epochs 1",
}
"""What is printed, and what runs in its place."""
RUN = [page for page in TASK_PAGES if "mymodels" not in page.read_text(encoding="utf-8")]  # a fit runs above


@pytest.fixture(scope="module")
def filled(reader, tmp_path_factory):
    folder, given = reader
    return shutil.copytree(folder, tmp_path_factory.mktemp("tasks") / "reader", symlinks=True), given


@pytest.fixture
def kept_level():
    """A page sets what semfov logs."""
    log = logging.getLogger("semfov")
    level = log.level
    yield
    log.setLevel(level)


@pytest.mark.slow
@pytest.mark.usefixtures("kept_level")
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_a_page_runs_as_printed(page, filled, monkeypatch, capsys, one_thread):
    folder, given = filled
    monkeypatch.chdir(folder)
    names = dict(given)
    text = page.read_text(encoding="utf-8")
    for printed, run in SHORTER.items():
        text = re.sub(printed, run, text)
    for language, block in re.findall(r"```(python|sh)\n(.*?)```", text, re.DOTALL):
        if language == "python":
            exec(compile(block, page.name, "exec"), names)
            plt.close("all")
        else:
            for line in block.splitlines():
                assert main(shlex.split(line)[1:]) == 0, capsys.readouterr().err


def test_the_table_of_counts_sums_what_has_a_number_that_is_no_guess(tmp_path, monkeypatch, capsys):
    lines = [
        "picture,class,object,expected,expected_error,expected_guessed,error",
        "a.jpg,person,0,10,3,False,",
        "a.jpg,person,1,10,3,False,",
        "b.jpg,person,0,,,False,",  # without a number
        "c.jpg,person,0,9,10,True,",
        "d.jpg,,,,,,not an image",
    ]
    (tmp_path / "people.csv").write_text("\n".join(lines), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", (TASKS / "count.md").read_text(encoding="utf-8"), re.DOTALL)
    (block,) = [block for block in blocks if "read_csv" in block]
    exec(compile(block, "count.md", "exec"), {})
    assert capsys.readouterr().out.endswith("\n10 in 1 of 3 pictures\n")


def test_every_page_is_in_the_index_and_on_the_site():
    index, site = (TASKS / "index.md").read_text(encoding="utf-8"), (TASKS.parents[1] / "mkdocs.yml").read_text()
    for page in TASK_PAGES:
        assert page.stem == "index" or f"({page.name})" in index
        assert f"tasks/{page.name}" in site


@pytest.mark.parametrize("page", TASK_PAGES, ids=lambda page: page.stem)
def test_code_fits_on_a_screen_and_needs_no_checkout(page):
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"```\w*\n(.*?)```", text, re.DOTALL):
        assert len(block.splitlines()) <= 30
    assert "needs a checkout" in text or not re.search(r"python -m (eval|train|benchmarks)|pip install -e", text)
