"""Write `constraints.txt`: the versions, in this environment, of all that the tests need. `make constraints`."""

import tomllib
from collections.abc import Iterable, Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

FILE = Path(__file__).parents[1] / "constraints.txt"
PROJECT = tomllib.loads((FILE.parent / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]
HEAD = """\
# The versions that the tests run with: `make constraints` writes them, `make setup` takes them.
# Users are not bound by them; pyproject.toml has the lower bounds.
"""


def needed(texts: Iterable[str], extras: frozenset[str], seen: set[tuple[str, frozenset[str]]]) -> Iterator[str]:
    """Names of what is required, with some extras, and of what that requires."""
    for text in texts:
        requirement = Requirement(text)
        if requirement.marker and not any(requirement.marker.evaluate({"extra": extra}) for extra in ("", *extras)):
            continue
        name, wanted = canonicalize_name(requirement.name), frozenset(requirement.extras)
        if (name, wanted) in seen:
            continue
        seen.add((name, wanted))
        if name == "semfov":
            yield from needed([each for extra in sorted(wanted) for each in EXTRAS[extra]], frozenset(), seen)
            continue
        try:
            requires = distribution(name).requires or []
        except PackageNotFoundError:
            continue  # of a platform that this is not
        yield name
        yield from needed(requires, wanted, seen)


def pins() -> list[str]:
    """`name==version` of everything, sorted."""
    names = {*needed([*PROJECT["dependencies"], "semfov[dev]"], frozenset(), set())}
    return [f"{name}=={distribution(name).version.partition('+')[0]}" for name in sorted(names)]


if __name__ == "__main__":
    FILE.write_text(HEAD + "\n".join(pins()) + "\n", encoding="utf-8")
    print(f"written: {FILE.name}")
