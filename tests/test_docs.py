"""Guides run as they stand, and the reference has every public name."""

import importlib.util
import inspect
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = sorted(DOCS.glob("guides/*.md"))


def reference():
    """The generator of the reference."""
    spec = importlib.util.spec_from_file_location("api", DOCS / "api.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.weights
@pytest.mark.filterwarnings("ignore:levels with fewer than")
@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_guides_run(guide, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", guide.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(block, guide.name, "exec"), namespace)


def test_there_is_a_guide_for_every_room():
    rooms = {"sensor", "detection", "observation", "belief", "gaze", "evaluation"}
    assert {guide.stem for guide in GUIDES} >= rooms


def test_every_public_name_is_explained():
    entries = reference().entries()
    for module, things in entries.items():
        for name, thing in things:
            assert inspect.getdoc(thing), f"{module}.{name} has no docstring"
            assert len(inspect.getdoc(thing).splitlines()[0]) > 10, f"{module}.{name}"


def test_reference_has_every_public_name():
    """`python docs/api.py` writes it again."""
    headings = re.findall(r"^### (\S+)$", (DOCS / "api.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings == [f"{module}.{name}" for module, things in reference().entries().items() for name, _ in things]
