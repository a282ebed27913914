"""Write `constraints.txt`: the installed version of every package that the tests need. Run by `make constraints`."""

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
# The versions that the tests run with: `make constraints` writes them, `make setup` installs them.
# Users are not bound by them; pyproject.toml has the lower bounds.
"""


def needed(texts: Iterable[str], extras: frozenset[str], seen: set[tuple[str, frozenset[str]]]) -> Iterator[str]:
    """Yield the names of all required packages, including the requirements of requirements.

    Args:
        texts: requirements.
        extras: extras of the package whose requirements these are.
        seen: packages with their extras that were visited already. New ones are added.

    Yields:
        The name of an installed package.
    """
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
            continue  # the package is for another platform
        yield name
        yield from needed(requires, wanted, seen)


def pins() -> list[str]:
    """Return `name==version` of all required packages, sorted."""
    names = {*needed([*PROJECT["dependencies"], "semfov[dev]"], frozenset(), set())}
    return [f"{name}=={distribution(name).version.partition('+')[0]}" for name in sorted(names)]


if __name__ == "__main__":
    FILE.write_text(HEAD + "\n".join(pins()) + "\n", encoding="utf-8")
    print(f"written: {FILE.name}")
