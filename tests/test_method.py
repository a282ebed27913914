"""The code that docs/method.md names for each equation exists, and it lists the paper's equations and figures."""

import importlib
import os
import re
from pathlib import Path

import pytest

from eval.figures import _FIGURES
from eval.page.figures import PAGE_FIGURES

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
