"""The code of the guides runs as printed, and the reference contains every public name."""

import inspect
import re
from pathlib import Path

import pytest

import semfov
from docs.api import entries, pages

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
