"""Digests of code change with everything that a result depends on, and with nothing else."""

import sys
import textwrap
import types
from importlib.util import LazyLoader, find_spec, module_from_spec

import pytest

from semfov.io import code, modules


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Function that writes a module of user code and imports it."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def write(name, text):
        path = tmp_path / f"{name}.py"
        path.write_text(textwrap.dedent(text))
        sys.modules.pop(name, None)
        return __import__(name)

    yield write
    for path in tmp_path.glob("*.py"):
        sys.modules.pop(path.stem, None)


HELPER = '''
"""Helps."""
def better(a, b):
    """Which is better."""
    return a > b  # the larger one
'''
POLICY = """
import math
import torch
import semfov
from own_helper import better
class Policy(torch.nn.Module):
    def forward(self, a, b):
        return better(math.sqrt(a), b)
"""


def test_the_digest_of_a_class_depends_on_imported_user_code(package):
    package("own_helper", HELPER)
    first = code.class_digest(package("own_policy", POLICY).Policy)
    package("own_helper", HELPER.replace("larger", "smaller").replace("Which", "What"))
    assert code.class_digest(package("own_policy", POLICY).Policy) == first, "comments and docstrings do not count"
    package("own_helper", HELPER.replace("a > b", "a < b"))
    assert code.class_digest(package("own_policy", POLICY).Policy) != first
    package("own_helper", HELPER)
    assert code.class_digest(package("own_policy", POLICY).Policy) == first
    assert code.class_digest(package("own_policy", POLICY.replace("sqrt", "log")).Policy) != first


def test_digests_of_classes(package):
    module = package("own_pair", "class One:\n    pass\nclass Two:\n    pass\n")
    assert code.class_digest(module.One) != code.class_digest(module.Two)
    typed = type("Typed", (), {"__module__": "__nowhere__"})
    assert code.class_digest(typed) == code.class_digest(typed)
    assert "process" in code.class_digest(typed)


def test_the_code_of_looks_does_not_include_beliefs_or_gaze():
    from semfov.runs.looks import LOOK_SOURCES

    files = code._closure(LOOK_SOURCES, lambda name: name.startswith("semfov."))
    folders = {file.relative_to(file.parents[1]).as_posix() for file in files}
    for name in ("sensor/pyramid.py", "detection/selection.py", "detection/onnx_heads.py", "data/images.py"):
        assert name in folders
    assert any(name.endswith("semfov/eye.py") for name in map(str, files))
    assert not any(name.startswith(("gaze/", "observation/", "training/")) for name in folders)
    assert {name for name in folders if name.startswith("belief/")} <= {"belief/grid.py"}


def test_relative_imports_and_packages_are_followed(tmp_path, monkeypatch):
    folder = tmp_path / "own_package"
    folder.mkdir()
    (folder / "__init__.py").write_text("from . import a\n")
    (folder / "a.py").write_text("from .b import value\n")
    (folder / "b.py").write_text("value = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    files = code._closure(["own_package"], lambda name: name.startswith("own_package"))
    assert {file.name for file in files} == {"__init__.py", "a.py", "b.py"}
    for name in [name for name in sys.modules if name.startswith("own_package")]:
        sys.modules.pop(name)


USER = "import own_library\nfrom own_library.part import value\nclass Policy:\n    pass\n"


def library(folder, text="raise SystemError('it was imported')\n"):
    """A library that must not be imported, in a folder."""
    (folder / "own_library").mkdir(parents=True)
    (folder / "own_library" / "__init__.py").write_text(text)
    (folder / "own_library" / "part.py").write_text("value = 1\n")
    return folder


def metadata(folder, name="own_library-1.dist-info", record="own_library/__init__.py,,\n"):
    (folder / name).mkdir(parents=True)
    (folder / name / "METADATA").write_text("Name: own-library\nVersion: 1\n")
    (folder / name / "RECORD").write_text(record)


def user_files(tmp_path, monkeypatch):
    """Names of the files of a user's module that imports the library; it is found, and not imported."""
    (tmp_path / "own_user.py").write_text(USER)
    monkeypatch.syspath_prepend(str(tmp_path))
    files = code._closure(["own_user"], lambda name: name == "own_user" or not modules.belongs_to_others(name))
    assert not {"own_library", "own_library.part", "own_user"} & sys.modules.keys()
    return sorted(file.relative_to(tmp_path).as_posix() for file in files if file.is_relative_to(tmp_path))


def test_without_metadata_imported_code_is_the_users_and_is_not_imported(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(library(tmp_path)))
    assert user_files(tmp_path, monkeypatch) == ["own_library/__init__.py", "own_library/part.py", "own_user.py"]


@pytest.mark.parametrize("kind", ["site-packages", "dist-packages", "linked", "metadata", "editable"])
def test_libraries_of_other_environments_are_not_the_users(tmp_path, monkeypatch, kind):
    folder = tmp_path / "other" / (kind if kind.endswith("packages") else "folder")
    if kind == "linked":
        library(tmp_path / "other" / "site-packages")
        folder.symlink_to("site-packages")
    else:
        library(folder)
    if kind == "metadata":
        metadata(folder)
    if kind == "editable":
        metadata(tmp_path / "site-packages", record="own_library.pth,,\n")
        origin = tmp_path / "site-packages" / "own_library-1.dist-info" / "direct_url.json"
        origin.write_text(f'{{"url": "{folder.as_uri()}", "dir_info": {{"editable": true}}}}')
        monkeypatch.syspath_prepend(str(tmp_path / "site-packages"))
    monkeypatch.syspath_prepend(str(folder))
    assert user_files(tmp_path, monkeypatch) == ["own_user.py"]


def test_a_users_module_with_the_name_of_a_library_is_the_users(tmp_path, monkeypatch):
    metadata(tmp_path / "other")
    monkeypatch.syspath_prepend(str(tmp_path / "other"))
    monkeypatch.syspath_prepend(str(library(tmp_path)))
    assert len(user_files(tmp_path, monkeypatch)) == 3


@pytest.mark.parametrize("damage", ["metadata", "record", "address", "source", "depth", "bytes"])
def test_damaged_files_of_others_raise_nothing(tmp_path, monkeypatch, damage):
    sources = {"source": b"def (:", "depth": b"-" * 10**5 + b"1", "bytes": b"\0\xff"}
    folder = library(tmp_path / "other")
    if damage in sources:
        (folder / "own_library" / "__init__.py").write_bytes(sources[damage])
    else:
        metadata(folder)
        name = {"metadata": "METADATA", "record": "RECORD", "address": "direct_url.json"}[damage]
        (folder / "own_library-1.dist-info" / name).write_bytes(b'"\xff\n\0,{[')
    monkeypatch.syspath_prepend(str(folder))
    assert "own_user.py" in user_files(tmp_path, monkeypatch)
    code._digest((tmp_path / "other" / "own_library").glob("*"))
    assert code._digest([tmp_path / "missing.py"])


def test_strange_entries_among_the_loaded_modules_raise_nothing(tmp_path, monkeypatch):
    class Raising(types.ModuleType):
        def __getattr__(self, name):
            raise OSError(name)

    class Finder:
        @staticmethod
        def find_spec(name, path=None, target=None):
            raise OSError(name)

    for strange in (None, 5, Raising("own_strange"), types.SimpleNamespace(__file__=3, __path__=7)):
        monkeypatch.setitem(sys.modules, "own_strange", strange)
        for name in ("own_strange", "own_strange.part", "", ".part"):
            assert modules.source_file(name) is None
            assert not modules.belongs_to_others(name)
    monkeypatch.setattr(sys, "meta_path", [Finder()])
    assert modules.source_file("own_missing.part") is None


def test_a_module_that_loads_lazily_is_not_loaded(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(library(tmp_path)))
    spec = find_spec("own_library")
    spec.loader = LazyLoader(spec.loader)
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setitem(sys.modules, "own_library", module)
    assert modules.source_file("own_library") == tmp_path / "own_library" / "__init__.py"
    assert modules.source_file("own_library.part") == tmp_path / "own_library" / "part.py"


def test_modules_of_nested_namespaces_are_found(tmp_path, monkeypatch):
    (tmp_path / "own_space" / "inner").mkdir(parents=True)
    (tmp_path / "own_space" / "inner" / "a.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert modules.source_file("own_space.inner.a") == tmp_path / "own_space" / "inner" / "a.py"
    assert "own_space" not in sys.modules
