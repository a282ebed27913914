"""Docstrings of the reference are complete: arguments, results, errors, an example. The linter checks their form."""

import ast
import inspect
import re
import textwrap

import pytest

from docs.api import entries

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
