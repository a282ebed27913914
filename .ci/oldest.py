"""Pin every requirement of the package to its lower bound: `python .ci/oldest.py > oldest.txt`."""

import re
import tomllib
from pathlib import Path

PROJECT = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def oldest(requirements: list[str]) -> list[str]:
    """Return `name==bound` for every requirement that has a lower bound.

    Args:
        requirements: requirements, such as `torch>=2.6`.

    Returns:
        The pinned requirements.

    >>> oldest(["torch>=2.6", "kornia", "jsonargparse[signatures]>=4.49"])
    ['torch==2.6', 'jsonargparse==4.49']
    """
    found = (re.fullmatch(r"([\w.-]+)(?:\[[\w,]+\])?>=([\d.]+)", requirement) for requirement in requirements)
    return [f"{match[1]}=={match[2]}" for match in found if match]


if __name__ == "__main__":
    print("\n".join(oldest(PROJECT["dependencies"])))
