"""Guides run as they stand, and the reference has every public name."""

import inspect
import re
from pathlib import Path

import pytest

import semfov
from docs.api import entries, pages

DOCS = Path(__file__).parents[1] / "docs"
GUIDES = sorted(DOCS.glob("guides/*.md"))


@pytest.mark.weights
@pytest.mark.filterwarnings("ignore:levels with fewer than")
@pytest.mark.parametrize("guide", GUIDES, ids=lambda guide: guide.stem)
def test_guides_run(guide, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", guide.read_text(encoding="utf-8"), re.DOTALL):
        exec(compile(block, guide.name, "exec"), namespace)


@pytest.mark.parametrize("what", ["policy", "observer", "sensor"])
def test_guides_to_ones_own_show_the_whole_example(what):
    example = (DOCS.parent / "examples" / f"own_{what}.py").read_text(encoding="utf-8")
    assert f"```python\n{example}```" in (DOCS / "guides" / f"write_your_own_{what}.md").read_text(encoding="utf-8")


def test_guide_to_robots_shows_the_whole_node():
    node = (DOCS.parent / "examples" / "ros_node.py").read_text(encoding="utf-8")
    assert f"```py\n{node}```" in (DOCS / "guides" / "robots.md").read_text(encoding="utf-8")


def test_there_is_a_guide_for_every_room():
    rooms = {"sensor", "detection", "observation", "belief", "gaze", "evaluation"}
    assert {guide.stem for guide in GUIDES} >= rooms


def test_every_public_name_is_explained():
    for module, things in entries().items():
        for name, thing in things:
            assert inspect.getdoc(thing), f"{module}.{name} has no docstring"
            assert len(inspect.getdoc(thing).splitlines()[0]) > 10, f"{module}.{name}"


def test_reference_hangs_on_nothing_but_the_sources():
    """No address of an object, and no path of this machine, is in it."""
    text = "\n".join(pages().values())
    assert not re.search(r"0x[0-9a-f]{6}| at 0x", text)
    assert str(DOCS.parent) not in text


def test_reference_has_every_public_name_of_the_package():
    explained = {id(thing) for things in entries().values() for _, thing in things}
    names = [semfov, *(thing for thing in vars(semfov).values() if inspect.ismodule(thing) and thing is not semfov)]
    for module in names:
        if module.__name__ != "semfov" and module.__name__.split(".")[-1] not in semfov.__all__:
            continue
        public = getattr(module, "__all__", None) or []
        for name in public:
            thing = getattr(module, name)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                assert id(thing) in explained, f"{module.__name__}.{name}"
