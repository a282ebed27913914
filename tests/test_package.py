"""The package as a whole: its public names, the cost of importing it, and the direction of imports."""

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

import semfov

PACKAGE = Path(semfov.__file__).parent
ROOT = PACKAGE.parent

# A subpackage imports only from itself and from the subpackages before it.
SUBPACKAGES = [
    "version", "words", "attribute_words", "errors", "threads", "precision", "io", "data", "kinds", "settings",
    "motion", "sensor", "detection",
    "observation", "dirichlet", "belief", "observers", "gaze", "acquisition", "policies", "saliency", "eye",
    "episode", "decision", "zoom", "tracking", "head", "paths", "strategy", "agents", "live", "model_folder", "presets",
    "agent", "metrics", "viz", "report", "runs", "cli", "__main__", "baselines", "human", "envs", "fit",
]  # fmt: skip
# Others' models for comparison, what is known of people, the environments and the fits stand on all other rooms, which
# work without them. A command imports them when it is run.
ABOVE = ("baselines", "human", "envs", "fit")
# A record draws itself, writes its page and compares itself with people by rooms that come after it, in which alone are
# the packages that draw. Its methods import them when they are called, and nothing of them when the record is made. And
# public names that rooms above have taken over keep their places: they are imported when they are asked for. The remedy
# for a file that cannot be used names a published detector.
LATE = {
    ("paths", "viz"), ("paths", "report"), ("paths", "human"), ("cli", "human"),
    ("data", "human"), ("metrics", "human"), ("gaze", "baselines"), ("io", "detection"),
}  # fmt: skip
OUTSIDE = ("eval", "train", "tests", "benchmarks", "examples", "docs", "hubconf")


def test_public_names_are_found_when_they_are_asked_for():
    for name in semfov.__all__:
        assert getattr(semfov, name) is not None
    with pytest.raises(AttributeError):
        semfov.nosuch  # noqa: B018


def test_rooms_are_imported_by_the_names_that_the_package_gives_them():
    """As `from semfov.acquisition import …` does; a name that is not there is no attribute of them."""
    for room in ("acquisition", "dirichlet", "observers", "policies", "saliency"):
        module, own = import_module(f"semfov.{room}"), getattr(semfov, room)
        assert [name for name in own.__all__ if getattr(module, name) is not getattr(own, name)] == []
        assert not hasattr(module, "nosuch")


@pytest.mark.parametrize("words", [["--version"], ["search", "--help"], ["searhc"]])
def test_help_version_and_unknown_commands_import_no_tensors(words):
    code = f"import sys; from semfov.cli.main import main; main({words}); print('torch' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-1] == "False"


HEAVY = [
    *["kornia", "onnx", "onnxruntime", "pycocotools", "torchvision", "matplotlib", "cv2", "torch._dynamo"],
    *["gymnasium", "transformers"],
]


def test_import_is_light(fresh):
    code = f"import sys, semfov; print([m for m in {[*HEAVY, 'jsonargparse']} if m in sys.modules])"
    assert fresh(code).strip() == "[]"


COMMANDS = [
    ("semfov.cli.main", ["search", "--help-all"]),
    ("semfov.cli.main", ["search", "--target", "zebr"]),
    ("semfov.cli.main", ["find", "nosuch.jpg", "--target", "cup"]),
    ("eval.search", ["--help"]),
    ("eval.search", ["--workers", "0"]),
    ("eval.explore", ["--detector.name", "yolo"]),
    ("train.fit_fom", ["--help"]),
]

IMPORTED = f"""
import importlib, sys
try:
    code = importlib.import_module(%r).main(%r)
except SystemExit as stopped:
    code = stopped.code
print()
print(code, [m for m in {HEAVY} if m in sys.modules])
"""


@pytest.mark.slow
@pytest.mark.parametrize(("command", "words"), COMMANDS, ids=str)
def test_help_and_wrong_arguments_import_no_heavy_packages(fresh, command, words):
    """The start takes long because of imports, so the test checks them instead of the time."""
    wanted = 0 if "--help" in " ".join(words) else 1
    assert fresh(IMPORTED % (command, words)).splitlines()[-1] == f"{wanted} []"


@cache
def imports(source: str) -> list[tuple[str, str]]:
    """All imports of a module, also inside functions: the module that is named, and the full name that is imported.

    No name is relative, as ruff tells.

    Raises:
        ValueError: the name of an import is computed at run time.
    """
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [(alias.name, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found += [(node.module, f"{node.module}.{alias.name}") for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in ("import_module", "__import__"):
            raise ValueError(f"line {node.lineno}: expected a statement, got {ast.unparse(node)}")
    return found


ALONE = """
import sys
from importlib.abc import MetaPathFinder

class Refusal(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in REFUSED:
            raise ImportError(f"{name} is not installed")

sys.meta_path.insert(0, Refusal())
for name in [*sys.modules]:  # what start files of the environment have imported
    if name.partition(".")[0] in REFUSED:
        del sys.modules[name]
import torch
import semfov
from semfov.sensor import LogPolar

image, fixation, grid = torch.rand(1, 3, 64, 64), torch.tensor([[32.0, 32.0]]), semfov.Grid(4, 4, (64, 64))
views = semfov.Foveation(10.0)(image, fixation), LogPolar(9.0)(image, fixation)
model = semfov.FovealObservationModel.from_pretrained("yolox-nano").requires_grad_(False)
observer = semfov.observers.Semantic(81, model)
seen = semfov.Detections(torch.tensor([[[9.0, 9, 30, 30]]]), torch.full((1, 1, 81), 1 / 81), torch.tensor([[True]]))
belief = observer(observer.start(1, grid, fixation), seen, fixation, grid)
visited = torch.zeros(1, 16, dtype=torch.bool)
for acquisition in (semfov.acquisition.TargetPosterior(1), semfov.acquisition.KLDivergence(model, grid)):
    print(acquisition(belief, visited).shape)
"""


def test_the_modules_alone_need_four_packages(fresh):
    """Those of docs/install.md, with the packages that torch itself needs, as filelock."""
    few = ["torch", "numpy", "lazy-loader", "safetensors"]
    assert f"pip install {' '.join(few)}\n" in (ROOT / "docs/install.md").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needed = {re.split(r"[<>=\[]", each)[0] for each in project["dependencies"]}
    refused = needed - {*few, "filelock", "pillow", "pyyaml"} | {"PIL", "yaml", "cv2", "scipy", "tifffile"}
    names = sorted(name.replace("-", "_") for name in refused)
    assert fresh(f"REFUSED = {names}\n{ALONE}") == "torch.Size([1, 16])\n" * 2


def modules_of(folder: Path) -> dict[str, Path]:
    """Every module of a package, by its name."""
    found = {}
    for file in folder.rglob("*.py"):
        parts = (folder.name, *file.relative_to(folder).with_suffix("").parts)
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = file
    return found


def imports_of(module: str, file: Path) -> list[tuple[str, str]]:
    """The imports of a module, without those in functions from a room that comes later (`LATE`)."""
    source = file.read_text(encoding="utf-8")
    functions = late_part(source) if room_of(module) in {room for room, _ in LATE} else ""
    found, late = (Counter(imports(part)) for part in (source, functions))
    later = {each for each in late if (room_of(module), room_of(each[0])) in LATE}
    allowed = {each for each in later if found[each] == late[each]}
    return [each for each in found if each not in allowed]


def room_of(module: str) -> str:
    return f"{module}..".split(".")[1]


def late_part(source: str) -> str:
    """What of a module does not run when it is imported: its functions, and imports that only checks of types read."""
    functions = (ast.FunctionDef, ast.AsyncFunctionDef)
    parts: list[ast.stmt] = []
    for node in ast.parse(source).body:
        if isinstance(node, ast.ClassDef):
            parts += [statement for statement in node.body if isinstance(statement, functions)]
        elif isinstance(node, functions) or (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            parts.append(node)
    return "\n".join(map(ast.unparse, parts))


def packages_above(module: str) -> Iterable[str]:
    while module := module.rpartition(".")[0]:
        yield module


def graph_of(modules: dict[str, Path]) -> dict[str, set[str]]:
    """The modules that the import of each module runs: the modules that it names, and the packages above them.

    Packages above the module itself are left out, as their import has already started.
    """
    graph: dict[str, set[str]] = {}
    for module, file in modules.items():
        runs: set[str] = set()
        for asked, taken in imports_of(module, file):
            here = next((name for name in (taken, asked) if name in modules), None)
            if here is not None:
                runs |= {here, *packages_above(here)}
        graph[module] = runs - set(packages_above(module)) - ({module} if file.name == "__init__.py" else set())
    return graph


MODULES = modules_of(PACKAGE)
APPS = {app: modules_of(ROOT / app) for app in ("train", "eval")}


def test_the_scan_finds_every_form_of_import():
    for source, found in (
        ("import torch, semfov.eye as e", [("torch", "torch"), ("semfov.eye", "semfov.eye")]),
        ("from semfov import Eye, viz", [("semfov", "semfov.Eye"), ("semfov", "semfov.viz")]),
        ("def late():\n    if True:\n        from semfov.agent import tell", [("semfov.agent", "semfov.agent.tell")]),
        ("class A:\n    import semfov.viz", [("semfov.viz", "semfov.viz")]),
        ("try:\n    pass\nexcept ImportError:\n    import eval.page", [("eval.page", "eval.page")]),
        ("text = 'import semfov.viz'  # from semfov import viz", []),
    ):
        assert imports(source) == found
    for hidden in ("import_module('semfov.viz')", "x = __import__('semfov.' + room).viz"):
        with pytest.raises(ValueError, match="line 1: expected a statement"):
            imports(hidden)


def test_only_imports_in_functions_may_come_late(tmp_path):
    late, early = "def draw():\n    import semfov.viz.curves", "import semfov.viz.curves"
    (tmp_path / "base.py").write_text(late)
    assert imports_of("semfov.paths.base", tmp_path / "base.py") == []
    for module, source in (("semfov.paths.base", f"{early}\n{late}"), ("semfov.zoom.eye", late)):
        (tmp_path / "base.py").write_text(source)
        assert ("semfov.viz.curves", "semfov.viz.curves") in imports_of(module, tmp_path / "base.py")


def test_every_subpackage_is_in_the_import_order():
    found = {name.split(".")[1] for name in MODULES if name != "semfov"}
    assert sorted(SUBPACKAGES) == sorted(found)


@pytest.mark.parametrize("subpackage", [*SUBPACKAGES, ""])
def test_imports_go_in_one_direction(subpackage):
    """The package itself, last, only re-exports names of its subpackages."""
    files = {
        name: file for name, file in MODULES.items() if name.split(".")[1:2] == ([subpackage] if subpackage else [])
    }
    assert files
    allowed = SUBPACKAGES[: SUBPACKAGES.index(subpackage) + 1] if subpackage else SUBPACKAGES
    for module, file in files.items():
        for asked, taken in imports_of(module, file):
            first, *more = taken.split(".")
            assert first not in OUTSIDE, f"{module} imports {taken}"
            if first == "semfov":
                assert asked != "semfov", f"{module} imports from the package as a whole: {taken}"
                assert more[0] in allowed, f"{module} imports {taken}"


def imports_when_imported(source: str) -> set[str]:
    """The rooms that the import of a module runs; those in functions are left out."""
    late = Counter(imports(late_part(source)))
    return {room_of(asked) for asked, _ in Counter(imports(source)) - late}


def test_rooms_above_the_line_come_last():
    assert SUBPACKAGES[-len(ABOVE) :] == [*ABOVE]


@pytest.mark.parametrize("room", SUBPACKAGES[: -len(ABOVE)])
def test_the_core_does_not_import_the_rooms_that_stand_on_it(room):
    for module, file in MODULES.items():
        if room_of(module) == room:
            assert {*ABOVE}.isdisjoint(imports_when_imported(file.read_text(encoding="utf-8"))), module


def test_an_import_of_a_fit_is_found_unless_it_is_in_a_function():
    late = "def run():\n    from semfov.fit.detector import fit_folder"
    assert imports_when_imported(late) == set()
    assert imports_when_imported(f"import semfov.envs\n{late}") == {"envs"}
    assert imports_when_imported(f"from semfov.fit.detector import fit_folder\n{late}") == {"fit"}


SEARCHED = f"""
import sys, semfov
from semfov.gaze.policies import Policy
record = semfov.ActivePerception.recommended().search("semfov/data/photographs/market.jpg", "person", passes=1)
record.describe(), record.as_fixations("market.jpg"), Policy("random")
print(sorted(room for room in {ABOVE} if "semfov." + room in sys.modules))
"""


@pytest.mark.slow
def test_a_search_runs_without_the_rooms_above(fresh):
    assert fresh(SEARCHED).strip() == "[]"


def test_imports_have_no_cycles():
    graph = graph_of(MODULES | APPS["train"] | APPS["eval"])
    assert sum(map(len, graph.values())) > 500
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" imports ".join(reversed(error.args[1])))


def test_import_cycles_are_detected(tmp_path):
    """Also cycles through a package, whose `__init__` runs when a module in it is imported."""
    folder = tmp_path / "toy"
    sources = {
        "__init__.py": "", "one.py": "def f():\n    from toy.rooms.two import g",
        "rooms/__init__.py": "import toy.three", "rooms/two.py": "from toy.rooms import four",
        "rooms/four.py": "", "three.py": "pass",
    }  # fmt: skip
    for name, source in sources.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(source)
    assert graph_of(modules_of(folder)) == {
        "toy": set(), "toy.one": {"toy.rooms", "toy.rooms.two"}, "toy.rooms": {"toy.three"},
        "toy.rooms.two": {"toy.rooms.four"}, "toy.rooms.four": set(), "toy.three": set(),
    }  # fmt: skip
    TopologicalSorter(graph_of(modules_of(folder))).prepare()
    (folder / "three.py").write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from toy import one")
    with pytest.raises(CycleError):
        TopologicalSorter(graph_of(modules_of(folder))).prepare()


@pytest.mark.parametrize(("app", "later"), [("train", {"eval"}), ("eval", set())])
def test_studies_may_import_fits_and_not_the_other_way_round(app, later):
    assert APPS[app]
    for module, file in APPS[app].items():
        for _, taken in imports_of(module, file):
            assert taken.split(".")[0] not in {"tests", "benchmarks", "examples", "docs"} | later, f"{module}: {taken}"
