"""The API reference from docstrings: `python docs/api.py` writes `docs/api.md`."""

import importlib
import inspect
import re
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "api.md"
MODULES = (
    "semfov",
    "semfov.sensor",
    "semfov.detection",
    "semfov.observation",
    "semfov.observation.dirichlet",
    "semfov.belief",
    "semfov.belief.observers",
    "semfov.belief.fusion",
    "semfov.gaze",
    "semfov.gaze.policies",
    "semfov.gaze.acquisition",
    "semfov.gaze.saliency",
    "semfov.episode",
    "semfov.live",
    "semfov.scanpath",
    "semfov.viz",
    "semfov.zoom",
    "semfov.head",
    "semfov.envs",
    "semfov.data",
    "semfov.data.fixations",
    "semfov.metrics.scanpath",
    "semfov.errors",
)
_ARRAY = "numpy.ndarray[tuple[Any, ...], numpy.dtype[Any]]"
_ALIASES = {
    f"Tensor, {_ARRAY}, str, os.PathLike[str], ForwardRef('Image')": "ImageLike",
    f"Tensor | {_ARRAY} | Sequence[Any]": "PointLike",
}
"""What `semfov.data.inputs` calls its unions; signatures write them out."""
_SECTION = re.compile(r"^(Args|Returns|Raises|Attributes|Shape|Example):{1,2}$")


def entries() -> dict[str, list[tuple[str, Any]]]:
    """Names that each module is the home of, with what they stand for; nothing stands twice."""
    seen: set[int] = set()
    found: dict[str, list[tuple[str, Any]]] = {}
    # Rooms first: the package only hands on what is theirs.
    for name in (*MODULES[1:], MODULES[0]):
        module = importlib.import_module(name)
        public = getattr(module, "__all__", None) or [n for n, t in vars(module).items() if _own(t, name)]
        things = [(n, getattr(module, n)) for n in sorted(public)]
        things = [(n, t) for n, t in things if (inspect.isclass(t) or inspect.isfunction(t)) and id(t) not in seen]
        seen |= {id(t) for _, t in things}
        found[name] = things
    return {name: found[name] for name in MODULES if found[name]}


def _own(thing: Any, module: str) -> bool:
    public = inspect.isclass(thing) or inspect.isfunction(thing)
    return public and thing.__module__ == module and not thing.__name__.startswith("_")


def page() -> str:
    """The whole page."""
    lines = ["# API reference", "", "Written by `python docs/api.py` from the docstrings.", ""]
    for module, things in entries().items():
        about = inspect.getdoc(importlib.import_module(module)) or ""
        lines += [f"## {module}", "", about.split("\n\n")[0], ""]
        for name, thing in things:
            lines += [f"### {module}.{name}", "", "```python", f"{name}{signature(thing)}", "```", ""]
            lines += [markdown(inspect.getdoc(thing) or ""), ""]
            lines += methods(thing)
    return "\n".join(lines)


def signature(thing: Any) -> str:
    """Arguments, without annotations of the result."""
    try:
        text = str(inspect.signature(thing).replace(return_annotation=inspect.Signature.empty))
    except (TypeError, ValueError):
        return ""
    text = re.sub(r"(?:torch|typing|collections\.abc|pathlib|semfov(?:\.\w+)+)\.(?=\w)", "", text)
    for kinds, name in _ALIASES.items():
        text = text.replace(kinds, name)
    return re.sub(r"Union\[([^][]*)\]", lambda union: union[1].replace(", ", " | "), text)


def methods(thing: Any) -> list[str]:
    """First lines of a class's own public methods."""
    if not inspect.isclass(thing):
        return []
    lines = []
    ours = [parent for parent in thing.__mro__ if parent.__module__.startswith("semfov")]
    inherited = {name: member for parent in reversed(ours) for name, member in vars(parent).items()}
    for name, member in ({**vars(thing)} | inherited).items():
        target = member.__func__ if isinstance(member, classmethod | staticmethod) else member
        target = target.fget if isinstance(target, property) else target
        if name.startswith("_") or not inspect.isfunction(target) or not target.__doc__:
            continue
        call = "" if isinstance(member, property) else "()"
        lines.append(f"- `{name}{call}`: {inspect.cleandoc(target.__doc__).split(chr(10) * 2)[0]}")
    return [*lines, ""] if lines else []


def markdown(text: str) -> str:
    """A docstring: formulas and examples fenced, sections in bold, their entries as lists."""
    text = re.sub(r":math:`([^`]*)`", r"$\1$", text)
    lines: list[str] = []
    for block in re.split(r"\n\s*\n", text):
        first = block.strip().splitlines()[0] if block.strip() else ""
        if first.startswith(".. math::"):
            lines += ["```math", inspect.cleandoc(block.strip().removeprefix(".. math::")), "```", ""]
        elif first.startswith(">>>"):
            lines += ["```pycon", inspect.cleandoc(block), "```", ""]
        elif _SECTION.match(first):
            rest = inspect.cleandoc("\n".join(block.strip().splitlines()[1:]))
            lines += [f"**{first.rstrip(':')}**", ""]
            lines += [re.sub(r"(?m)^(\w[\w, *]*): ", r"- `\1`: ", rest), ""]
        else:
            lines += [block, ""]
    return "\n".join(lines).strip()


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(f"written: {PAGE}")
