"""Contents of pages: links of names, docstrings, formulas, links between files."""

import doctest
import xml.etree.ElementTree as etree

import markdown
import pytest

import docs.api
import docs.site.formulas
import docs.site.stage
from docs.site.docstrings import markdown as docstring
from docs.site.formulas import mathml
from docs.site.names import Names
from docs.site.stage import Stage, place_of
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
    text = names.link("`semfov.fit.evidence.evidence_objective`", inside)
    assert text == "[`semfov.fit.evidence.evidence_objective`][semfov.fit.evidence.evidence_objective]"
    assert inside == {"semfov.fit.evidence.evidence_objective"}
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
    for name in ["semfov.MissModel", "semfov.sensor.fovea", "semfov.Foveation.close"]:
        with pytest.raises(LookupError, match="does not exist"):
            names.link(f"see `{name}`")
    with pytest.raises(ValueError, match="foo"):
        mathml(r"\foo{a}", block=False)
    stage = Stage(tmp_path)
    stage.page("[here](nowhere.md)", "docs/method.md")
    with pytest.raises(LookupError, match=r"docs/method\.md links to nowhere\.md"):
        stage.finish()


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
