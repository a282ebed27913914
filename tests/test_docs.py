"""The code of the guides runs, the reference has every public name, and docs/method.md what the paper has."""

import importlib
import inspect
import os
import re
from pathlib import Path

import pytest

import semfov
from docs.api import entries, pages
from eval.figures import _FIGURES
from eval.page.figures import PAGE_FIGURES

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = [*sorted(DOCS.glob("guides/*.md")), DOCS / "pan-tilt.md"]
PAGES = [DOCS.parent / "README.md", DOCS.parent / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


@pytest.mark.weights
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


def test_every_equation_of_the_paper_is_listed_with_its_code_or_the_reason_for_none():
    rows = rows_of("The paper's equations")
    assert [int(number) for number, *_ in rows] == list(range(1, len(EQUATIONS) + 1))
    assert [None if label == "without a label" else label.strip("`") for _, label, *_ in rows] == EQUATIONS
    assert [row for row in rows if not re.match(r"`semfov\.|none: ", row[-1])] == []


def test_equations_of_the_page_are_those_of_the_paper():
    assert len(ROWS) > 50
    assert len(SYMBOLS) > 40
    cited = {int(number) for group in re.findall(r"\((\d+(?:, \d+)*)\) \|", PAGE) for number in group.split(", ")}
    assert len(cited) > 10
    assert max(cited) <= len(EQUATIONS)


def test_every_figure_of_the_paper_is_listed_with_its_command_or_the_reason_for_none():
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
