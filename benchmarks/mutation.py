"""Mutation scores by module, and the mutants that no test notices, from what `mutmut run` left in `mutants/`.

    make mutation
    python -m benchmarks.mutation semfov.belief.fusion
    mutmut run $(python -m benchmarks.mutation semfov.belief --pending 200)

mutmut changes one operator, number, string or argument at a time and runs the tests that call the function. A mutant is
killed when a test fails. Mutants that no test can notice are set aside, whether they were killed or not: `_Words`
recognises some kinds by rule, and `mutation.toml` lists the others with the reason.
"""

import argparse
import ast
import inspect
import json
import pkgutil
import random
import re
import textwrap
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from benchmarks.tables import table

FOLDER = Path("mutants")
EQUIVALENT = Path(__file__).with_name("mutation.toml")
STATUS = {1: "killed", 3: "killed", 0: "survived", 5: "untested", 33: "untested", None: "not run"}
# Exit codes of mutants that did not end in time.
STATUS |= dict.fromkeys((-24, 24, 36, 152, 255), "killed")
HEAD = ("module", "killed", "survived", "untested", "not run", "aside", "score")
# Their first argument decides whether there is an error, the others are words of its message.
CHECKS = ("check", "check_finite", "check_pixels")


class Mutant(NamedTuple):
    """One change of one function.

    Attributes:
        name: the name that mutmut gives it.
        function: the function that is changed, with its module.
        change: the changed lines, as `ast.unparse` writes them, joined by newlines.
        status: `killed`, `survived`, `untested` (no test calls the function), `not run`, or `aside`.
    """

    name: str
    function: str
    change: str
    status: str


class _Words(ast.NodeTransformer):
    """Removes the code that no test is meant to notice.

    This is the text of error messages, the `strict=` of `zip`, upper and lower case in `float("nan")`, and `device=` on
    a machine without an accelerator.
    """

    left_out = ("strict",) if torch.cuda.is_available() else ("strict", "device")

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        name = node.func.id if isinstance(node.func, ast.Name) else ""
        if name in CHECKS:
            node.args[1:] = [ast.Constant("") for _ in node.args[1:]]
        elif name.startswith("check_"):
            node.args[1:2] = [ast.Constant("") for _ in node.args[1:2]]
        elif name == "lookup":
            node.args[2:] = [ast.Constant("") for _ in node.args[2:]]
        elif name == "float" and isinstance(node.args[0], ast.Constant):
            node.args[0] = ast.Constant(str(node.args[0].value).lower())
        node.keywords = [each for each in node.keywords if each.arg not in self.left_out]
        return node

    def visit_Raise(self, node: ast.Raise) -> ast.AST:
        return ast.Raise(node.exc.func) if isinstance(node.exc, ast.Call) else node


def _functions(tree: ast.Module) -> dict[str, ast.FunctionDef]:
    """Functions and methods of a module by name; mutmut's names of methods contain the class."""
    bodies = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.ClassDef))]
    return {node.name: node for body in bodies for node in body if isinstance(node, ast.FunctionDef)}


def _texts(function: ast.FunctionDef) -> tuple[str, str]:
    """Source of the function with its name removed, and the same after `_Words`."""
    function.name = "_"
    text = ast.unparse(function)
    return text, ast.unparse(_Words().visit(function))


def _change(before: str, after: str) -> str:
    """Lines of `after` between the beginning and the end that it shares with `before`."""
    old, new = before.splitlines(), after.splitlines()
    while old and new and old[0] == new[0]:
        del old[0], new[0]
    while old and new and old[-1] == new[-1]:
        del old[-1], new[-1]
    return "\n".join(line.strip() for line in new)


def read(path: Path, equivalent: Mapping[str, Sequence[str]]) -> Iterator[Mutant]:
    """Read the mutants of one module.

    Args:
        path: the mutated module in `mutants/`, beside which mutmut keeps its results.
        equivalent: changes to set aside, by function.

    Yields:
        Mutants, in mutmut's order.
    """
    codes = json.loads(path.with_name(path.name + ".meta").read_text(encoding="utf-8"))["exit_code_by_key"]
    functions = _functions(ast.parse(path.read_text(encoding="utf-8")))
    texts = {name: _texts(node) for name, node in functions.items() if "__mutmut_" in name}
    for name, code in codes.items():
        module, _, own = name.rpartition(".")
        stem = own.rpartition("__mutmut_")[0]
        # x_function, or xǁClassǁmethod
        function = ".".join([module, *stem[2:].split("ǁ")])
        (before, silent), (after, silent_after) = texts[f"{stem}__mutmut_orig"], texts[own]
        change = _change(before, after)
        aside = silent == silent_after or change in equivalent.get(function, ())
        yield Mutant(name, function, change, "aside" if aside else STATUS.get(code, "killed"))


def score(counts: Mapping[str, int]) -> str:
    """Share of killed mutants among those that were run and not set aside, in percent."""
    run = counts["killed"] + counts["survived"] + counts["untested"]
    return f"{100 * counts['killed'] / run:.1f} %" if run else "–"


def listed() -> dict[str, list[str]]:
    """Return changes that `mutation.toml` sets aside, by function."""
    changes: dict[str, list[str]] = {}
    for group in tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))["equivalent"]:
        for entry in group["changes"]:
            function, _, change = entry.partition(": ")
            changes.setdefault(function, []).append(change)
    return changes


def lines(function: str) -> list[str]:
    """Lines of a function that mutmut changes.

    Args:
        function: its name, with its module.

    Returns:
        The lines as `ast.unparse` writes them; none if there is no such function, or if it has a decorator other than
        `classmethod` or `staticmethod`, because mutmut leaves it alone.
    """
    try:
        found = pkgutil.resolve_name(function)
    except (ImportError, AttributeError):
        return []
    if f"{getattr(found, '__module__', '')}.{getattr(found, '__qualname__', '')}" != function:
        return []
    (node,) = ast.parse(textwrap.dedent(inspect.getsource(found))).body
    decorators = [ast.unparse(each) for each in node.decorator_list] if isinstance(node, ast.FunctionDef) else [""]
    if decorators not in ([], ["classmethod"], ["staticmethod"]):
        return []
    return [line.strip() for line in ast.unparse(node).splitlines()]


def one_change(line: str, change: str) -> bool:
    """Whether a line was changed in one place.

    Args:
        line: the line.
        change: what may be the line after one change.

    Returns:
        True if one part of the line is left out, None, or one or two other words.

    >>> one_change("return a + b", "return a - b"), one_change("return a + b", "return c * d")
    (True, False)
    """
    old, new = (re.findall(r"\w+|'[^']*'|[^\w\s]", text) for text in (line, change))
    while old and new and old[0] == new[0]:
        del old[0], new[0]
    while old and new and old[-1] == new[-1]:
        del old[-1], new[-1]
    return old != new and (new in ([], ["None"]) or max(len(old), len(new)) <= 2)


def outdated(equivalent: Mapping[str, Sequence[str]]) -> list[str]:
    """List changes to set aside, after the name of their function, that change no line of the present code."""
    return [
        f"{function}: {change}"
        for function, changes in equivalent.items()
        for code in [lines(function)]
        for change in changes
        if not any(one_change(line, change) for line in code)
    ]


def main() -> None:
    """Print the survivors and the table of scores, or names of mutants that have not been run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("modules", nargs="*", help="first part of the modules' names; default: all modules")
    parser.add_argument(
        "--pending", type=int, metavar="N", help="print only the names of N mutants that have not been run"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of that draw")
    options = parser.parse_args()
    equivalent = listed()
    modules: dict[str, list[Mutant]] = {}
    for path in sorted(FOLDER.rglob("*.py.meta")):
        source = path.with_suffix("")
        module = ".".join(source.relative_to(FOLDER).with_suffix("").parts)
        if module.startswith(tuple(options.modules) or ""):
            modules[module] = list(read(source, equivalent))
    everything = [mutant for mutants in modules.values() for mutant in mutants]
    if options.pending is not None:
        names = [mutant.name for mutant in everything if mutant.status == "not run"]
        print(*random.Random(options.seed).sample(names, min(options.pending, len(names))))
        return
    for mutant in everything:
        if mutant.status in {"survived", "untested"}:
            print(f"{mutant.name} ({mutant.status})\n    " + mutant.change.replace("\n", "\n    "))
    rows = []
    for module, mutants in [*modules.items(), ("all", everything)]:
        counts = Counter(mutant.status for mutant in mutants)
        rows.append([module, *(str(counts[status]) for status in HEAD[1:-1]), score(counts)])
    print(table(HEAD, rows))


if __name__ == "__main__":
    main()
