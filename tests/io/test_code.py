"""Digests of code change with everything that a result depends on, and with nothing else."""

import sys
import textwrap

import pytest

from semfov.io import code


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


def test_two_classes_in_one_file_have_different_digests(package):
    module = package("own_pair", "class One:\n    pass\nclass Two:\n    pass\n")
    assert code.class_digest(module.One) != code.class_digest(module.Two)


def test_the_digest_of_a_class_without_a_file_is_valid_in_one_process_only():
    typed = type("Typed", (), {"__module__": "__nowhere__"})
    assert code.class_digest(typed) == code.class_digest(typed)
    assert "process" in code.class_digest(typed)


def test_the_code_of_looks_does_not_include_beliefs_or_gaze():
    from semfov.runs.looks import LOOK_SOURCES

    files = code.closure(LOOK_SOURCES, lambda name: name.startswith("semfov."))
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
    files = code.closure(["own_package"], lambda name: name.startswith("own_package"))
    assert {file.name for file in files} == {"__init__.py", "a.py", "b.py"}
    for name in [name for name in sys.modules if name.startswith("own_package")]:
        sys.modules.pop(name)
