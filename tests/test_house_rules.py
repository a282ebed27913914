"""Rules for the source code: short files, one meaning of each name, no private names of others, valid `__all__` lists.

The import order of subpackages is checked in `test_package.py`, code execution in `robustness/test_security.py`.
"""

import ast
import importlib
from collections import Counter
from pathlib import Path

import pytest

import semfov
from docs.api import MODULES, entries

PACKAGE = Path(semfov.__file__).parent
ROOT = PACKAGE.parent
LIBRARY = sorted(PACKAGE.rglob("*.py"))
SOURCES = LIBRARY + sorted(file for folder in ("eval", "train", "examples") for file in (ROOT / folder).rglob("*.py"))
MOST_LINES = 600
DOCUMENTED = {"os._exit"}


def private_names(source: str) -> list[str]:
    """Private names of other packages that a module imports or accesses, such as `torch._C`."""
    tree = ast.parse(source)
    found, foreign = [], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                foreign.add(alias.asname or alias.name.split(".")[0])
                found += [alias.name] if _is_private(alias.name) else []
        elif isinstance(node, ast.ImportFrom) and not node.level and node.module:
            own = node.module.split(".")[0] in ("semfov", "eval", "train", "examples", "__future__")
            for alias in node.names if not own else ():
                foreign.add(alias.asname or alias.name)
                name = f"{node.module}.{alias.name}"
                found += [name] if _is_private(name) else []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            name = ast.unparse(node)
            if name.split(".")[0] in foreign and _is_private(node.attr) and name not in DOCUMENTED:
                found.append(name)
    return found


def _is_private(name: str) -> bool:
    return any(part.startswith("_") and not part.endswith("__") for part in name.split("."))


def test_no_private_names_of_other_packages_are_used():
    for source in ("import torch\ntorch._C.f()", "from torch._dynamo import f", "import torch._inductor"):
        assert private_names(source)
    assert not private_names("import torch\nfrom semfov.errors import _to_unit\nself._kept = torch.__version__")
    found = {str(file.relative_to(ROOT)): private_names(file.read_text(encoding="utf-8")) for file in SOURCES}
    assert {name: parts for name, parts in found.items() if parts} == {}


def test_files_of_the_library_are_short_and_have_names_of_their_own():
    lines = {str(file.relative_to(ROOT)): len(file.read_text(encoding="utf-8").splitlines()) for file in LIBRARY}
    assert {name: count for name, count in lines.items() if count > MOST_LINES} == {}
    assert not {file.name for file in SOURCES} & {"utils.py", "helpers.py", "misc.py", "common.py"}


@pytest.mark.parametrize("module", MODULES)
def test_names_in_all_exist_once_and_are_public(module):
    names = getattr(importlib.import_module(module), "__all__", [])
    assert len(set(names)) == len(names)
    assert [name for name in names if not hasattr(importlib.import_module(module), name)] == []
    assert not [name for name in names if _is_private(name)]


def public_names(source: str) -> set[str]:
    """Public classes, functions and constants that a module defines at its top level."""
    found = set()
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id for target in targets if isinstance(target, ast.Name)}
    return {name for name in found if not name.startswith("_")}


def test_a_name_of_the_reference_means_one_thing():
    counts = Counter(name for file in LIBRARY for name in public_names(file.read_text(encoding="utf-8")))
    shown = {name for things in entries().values() for name, _ in things}
    assert {name for name in shown if counts[name] > 1} == set()
