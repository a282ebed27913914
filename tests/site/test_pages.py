"""Docstrings of the reference say what they must, and become pages."""

import ast
import doctest
import inspect
import json
import re
import textwrap
import xml.etree.ElementTree as etree

import markdown
import pytest

import docs.api
import docs.site.formulas
import docs.site.stage
import semfov
from docs.api import entries
from docs.site.__main__ import render
from docs.site.docstrings import markdown as docstring
from docs.site.formulas import mathml
from docs.site.names import Names
from docs.site.search_index import put_pages_first
from docs.site.stage import ROOT, Stage, place_of
from docs.site.tutorials import execute, page

SPACE = "{http://www.w3.org/1998/Math/MathML}"


@pytest.fixture(scope="module")
def names():
    return Names()


@pytest.mark.parametrize(
    ("name", "there"),
    [
        ("semfov.foveate", "semfov.sensor.foveate"),
        ("semfov.sensor.glimpse", "semfov.sensor.glimpse.glimpse"),
        ("semfov.dirichlet.mle", "semfov.observation.dirichlet.mle"),
        ("Foveation", "semfov.sensor.Foveation"),
        ("Foveation.open", "semfov.sensor.Foveation.open"),
        ("semfov.viz", "semfov.viz"),
        ("Tensor", None),
        ("semfov.__version__", None),
    ],
)
def test_names_link_to_the_page_of_their_definition(names, name, there):
    assert names.place(name) == there


def test_a_docstring_becomes_markdown(names):
    text = """Blur.

.. math:: a = b, \\quad
          c = d

which is :math:`a < c`, see `Foveation`.

Args:
    x: of `y`:

        .. math:: e

Example::

    blur(1)

>>> blur(1)
2
"""
    assert (
        docstring(text, names)
        == """Blur.

$$ a = b, \\quad c = d $$

which is $a < c$, see [`Foveation`][semfov.sensor.Foveation].

Args:
    x: of `y`:

        $$ e $$

**Example**

```python
blur(1)
```

```pycon
>>> blur(1)
2
```
"""
    )


def test_names_are_linked_where_they_are_names(names):
    text = "[`Foveation`](x.md), ``Foveation`` and Foveation"
    assert names.link(text) == text
    inside = set()
    text = names.link("`semfov.fit.through_belief.landing_loss`", inside)
    assert text == "[`semfov.fit.through_belief.landing_loss`][semfov.fit.through_belief.landing_loss]"
    assert inside == {"semfov.fit.through_belief.landing_loss"}
    module = "semfov.observation.dirichlet"
    assert docstring("see `entropy`", names, module) == "see [`entropy`][semfov.observation.dirichlet.entropy]"
    assert docstring("see `entropy`", names, module, {"entropy"}) == "see `entropy`"


def test_mathml_has_the_structure_of_the_formula():
    tree = etree.fromstring(mathml(r"\frac{a}{b_1} + \sqrt{c}", block=True))
    assert tree.get("display") == "block"
    above, below = tree.find(f".//{SPACE}mfrac")
    assert [part.text for part in above.iter() if part.text] == ["a"]
    assert [part.text for part in below.iter() if part.text] == ["b", "1"]
    assert below.find(f".//{SPACE}msub") is not None
    assert tree.find(f".//{SPACE}msqrt") is not None


@pytest.mark.parametrize(
    ("formula", "spaces"),
    [
        (r"\ln x", 1),
        (r"w \ln x", 2),
        (r"w \ln(x)", 1),
        (r"\log_2 p", 1),
        (r"\exp\left(x\right)", 0),
        (r"\ln\Gamma(x)", 1),
    ],
)
def test_spaces_around_functions_are_those_of_tex(formula, spaces):
    assert len(etree.fromstring(mathml(formula, block=False)).findall(f".//{SPACE}mspace")) == spaces


def test_formulas_are_converted_in_tables_and_other_dollars_are_not():
    for text in ["`$x$`", "it costs $5", "$HOME and $PATH", r"\$x\$"]:
        assert "<math" not in markdown.markdown(text, extensions=["docs.site.formulas"])
    html = markdown.markdown("| a | b |\n|---|---|\n| $x_i$ | c |", extensions=["docs.site.formulas", "tables"])
    assert "<td><math" in html


def test_names_commands_and_links_that_do_not_exist_are_refused(names, tmp_path):
    for name in ["semfov.MissModel", "semfov.sensor.retina", "semfov.Foveation.close"]:
        with pytest.raises(LookupError, match="does not exist"):
            names.link(f"see `{name}`")
    with pytest.raises(ValueError, match="foo"):
        mathml(r"\foo{a}", block=False)
    stage = Stage(tmp_path)
    stage.page("[here](nowhere.md)", "docs/method.md")
    with pytest.raises(LookupError, match=r"docs/method\.md links to nowhere\.md"):
        stage.finish()


@pytest.mark.parametrize("address", [None, "https://github.com/someone/semfov"])
def test_a_page_has_version_and_licence_and_a_link_that_asks_its_server_for_nothing(tmp_path, monkeypatch, address):
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[0]
    for line, here in (
        ("docs_dir: build/pages", "docs_dir: pages"),
        ("site_dir: build/site", "site_dir: site"),
        ("custom_dir: docs", f"custom_dir: {ROOT}/docs"),
    ):
        assert line in settings
        settings = settings.replace(line, here)
    (tmp_path / "mkdocs.yml").write_text(settings.replace("extra_css: [site.css]\n", ""), encoding="utf-8")
    (tmp_path / "pages").mkdir()
    (tmp_path / "pages/index.md").write_text("# A page\n", encoding="utf-8")
    monkeypatch.delenv("REPOSITORY_URL", raising=False)
    if address:
        monkeypatch.setenv("REPOSITORY_URL", address)
    done = render(tmp_path)
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site/index.html").read_text(encoding="utf-8")
    assert f"semfov {semfov.__version__}, MIT licence" in page
    assert page.count(f'<a href="{address}"') == (2 if address else 0)  # in the head, and in the menu of a telephone
    assert 'data-md-component="source"' not in page  # to which the theme adds stars and releases


def test_links_are_rewritten_to_the_paths_on_the_site(tmp_path):
    moved = Stage(tmp_path).page(
        "[a](../../examples/own_policy.py) [b](gaze.md#x) [c](https://d.org)", "docs/guides/belief.md"
    )
    assert moved == "[a](../repository/examples/own_policy.py.md) [b](gaze.md#x) [c](https://d.org)"
    assert place_of("README.md") == "index.md"
    assert place_of("docs/tutorials/search.py") == "tutorials/search.md"


@pytest.mark.parametrize("module", [docs.api, docs.site.formulas, docs.site.stage], ids=lambda module: module.__name__)
def test_docstring_examples_of_the_documentation_tools_pass(module):
    failed, tried = doctest.testmod(module)
    assert failed == 0
    assert tried > 0


@pytest.mark.slow
def test_a_tutorial_with_a_warning_is_refused(tmp_path):
    source = tmp_path / "warns.py"
    source.write_text("# %%\nimport warnings\nwarnings.warn('beware')\n", encoding="utf-8")
    with pytest.raises(ValueError, match="beware"):
        execute(source)


@pytest.mark.slow
def test_a_picture_without_alt_text_is_refused(tmp_path):
    source = tmp_path / "draws.py"
    source.write_text("# %%\nimport matplotlib.pyplot as plt\nplt.plot([0, 1]);\n", encoding="utf-8")
    notebook = execute(source)
    with pytest.raises(ValueError, match="expected alt="):
        page(notebook, "draws", tmp_path)
    notebook.cells[0].metadata["alt"] = "a line"
    assert "![a line](draws-0.png)" in page(notebook, "draws", tmp_path)


SECTION = re.compile(r"(?m)^(Args|Attributes|Returns|Yields|Raises):\n((?: +.*\n?|\n)*)")
PARTS = ("Args", "Attributes")
PLACES = [pytest.param(thing, id=f"{module}.{name}") for module, things in entries().items() for name, thing in things]


def sections(text):
    return {match[1]: match[2] for match in SECTION.finditer(text + "\n")}


def explained(block):
    """Names that a section explains: those at its lowest indentation."""
    lines = [line for line in block.splitlines() if line.strip()]
    indent = min((len(line) - len(line.lstrip()) for line in lines), default=0)
    heads = [line.split(":")[0] for line in lines if len(line) - len(line.lstrip()) == indent]
    return {name.strip().lstrip("*") for head in heads for name in head.split(",")}


def arguments(function):
    names = inspect.signature(function).parameters
    return {name for name in names if name not in ("self", "cls") and not name.startswith("_")}


def raised(function):
    """Names of errors raised in the code of a function."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    errors = [node.exc for node in ast.walk(tree) if isinstance(node, ast.Raise) and node.exc]
    names = {ast.unparse(error.func if isinstance(error, ast.Call) else error).split(".")[-1] for error in errors}
    return {name for name in names if name[0].isupper()} - {"NotImplementedError", "StopIteration"}


def check_function(function, text):
    told = sections(text)
    assert explained(told.get("Args", "")) == arguments(function)
    returns = inspect.signature(function).return_annotation not in (None, "None", inspect.Signature.empty)
    # The first line of a method without arguments says what it returns.
    if returns and (arguments(function) or "." not in function.__qualname__):
        assert {"Returns", "Yields"} & told.keys()
    assert raised(function) <= explained(told.get("Raises", ""))


def is_ours(cls):
    return cls.__module__.startswith("semfov")


def methods(cls):
    """Public methods that a class defines, except those documented in a base class of the package."""
    for name, thing in vars(cls).items():
        function = inspect.unwrap(getattr(thing, "__func__", thing)) if callable(thing) or name in vars(cls) else thing
        bases = [base for base in cls.__mro__[1:] if is_ours(base)]
        inherited = any(inspect.getdoc(vars(base).get(name)) for base in bases if name in vars(base))
        own = inspect.isfunction(function) and (function.__module__ or "").startswith("semfov")
        if own and not name.startswith("_") and not inherited:
            yield function


@pytest.mark.parametrize("thing", [place for place in PLACES if inspect.isfunction(place.values[0])])
def test_docstrings_of_functions_are_complete(thing):
    text = inspect.getdoc(thing)
    check_function(thing, text)
    assert ">>>" in text or "Example" in text


@pytest.mark.parametrize("thing", [place for place in PLACES if inspect.isclass(place.values[0])])
def test_docstrings_of_classes_are_complete(thing):
    text = inspect.getdoc(thing)
    if not issubclass(thing, BaseException):
        assert ">>>" in text or "Example" in text
        init = vars(thing).get("__init__")
        if inspect.isfunction(init) and not getattr(thing, "_is_protocol", False):
            # A data class explains its own attributes, and its base classes explain theirs.
            texts = [text, *(inspect.getdoc(base) or "" for base in thing.__mro__[1:] if is_ours(base))]
            told = [sections(each) for each in texts]
            assert arguments(init) <= {n for each in told for part in PARTS for n in explained(each.get(part, ""))}
    for function in methods(thing):
        check_function(function, inspect.getdoc(function))


def test_members_are_found_in_the_entry_of_their_class_and_files_and_internals_by_their_pages(tmp_path):
    entries = [
        ("tasks/find.html#threshold", "Threshold", "when"),
        ("api/semfov.paths.html", "semfov.paths", ""),
        ("api/semfov.paths.html#semfov.paths.Words", "semfov.paths.Words", "words"),
        (
            "api/semfov.paths.html#semfov.paths.Words.threshold",
            "threshold <small><code>property</code></small>",
            "from",
        ),
        ("api/semfov.paths.html#semfov.paths.open", "semfov.paths.open", "opens"),
        ("repository/examples/ros_node.py.html", "examples/ros_node.py", "import rclpy"),
        ("api/internals.html", "Internals", "what the pages name"),
        ("api/internals.html#semfov.belief.prior.Prior", "semfov.belief.prior.Prior", "prior"),
    ]
    index = tmp_path / "search.json"
    items = [{"location": place, "title": title, "text": text} for place, title, text in entries]
    index.write_text(json.dumps({"config": {"lang": ["en"]}, "items": items}))
    put_pages_first(index)
    written = json.loads(index.read_text(encoding="utf-8"))
    assert written["config"] == {"lang": ["en"]}
    assert written["items"] == [*items[:2], {**items[2], "text": "words<p>threshold</p>from"}, items[4]]
