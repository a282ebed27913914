"""Totals over the pictures of a command: objects found, and objects to expect, of each class."""

import math
from collections import Counter
from collections.abc import Collection, Sequence

from semfov.cli.jobs import PictureJob
from semfov.cli.options import PictureOptions
from semfov.data.classes import amount, counted, plural
from semfov.paths.conversion import Values
from semfov.paths.words import number_with_error


def found_in_all(job: PictureJob[PictureOptions], rows: Collection[Values]) -> str:
    """Count the objects of each class in all pictures of a find, also of one that was looked for and is nowhere.

    Args:
        job: what was to be done.
        rows: those of the pictures so far.

    Returns:
        The numbers found, and the expected ones where they are known; empty for other tasks, and where none was found.
    """
    if not job.every:
        return ""
    counts = Counter[str]()
    for row in rows:
        counts.update(dict.fromkeys(row.get("targets", ()), 0))
        counts.update(line["class"] for line in row.get("objects", ()))
    if not counts:
        return ""
    found = ", ".join(counted(number, name) for name, number in counts.most_common())
    return "; ".join(filter(None, [f"{found} found", expected_in_all(rows)]))


def expected_in_all(rows: Collection[Values]) -> str:
    """Say how many objects of each class that was looked for to expect in all pictures.

    The errors of pictures are independent: the square of that of the sum is the sum of their squares. Where pictures
    are without a number, or it is a guess, the sum is of the others, and says of how many. Guesses have a sum of their
    own.

    Args:
        rows: those of the pictures; ones that were left out have an `error`.

    Returns:
        The sums with their errors; empty where no picture has a number.
    """
    looked_at = [row for row in rows if "error" not in row]
    targets: dict[str, None] = {}  # each once, in their order
    for row in looked_at:
        targets |= dict.fromkeys(row["targets"])
    texts = []
    for target in targets:
        noun = f" {plural(target)}" if len(targets) > 1 else ""
        texts.append(_expected_of_class(looked_at, target, noun))
    return "; ".join(filter(None, texts))


def _expected_of_class(rows: Sequence[Values], target: str, noun: str) -> str:
    """Say how many objects of a class to expect in pictures; guesses are summed apart. Empty without a number.

    Args:
        rows: those of the pictures.
        target: the class.
        noun: what is counted, after a blank; empty where there is but one class.
    """
    known = [row for row in rows if row["expected"].get(target) is not None]
    guesses = [row for row in known if row["expected_guessed"][target]]
    numbers = [row for row in known if not row["expected_guessed"][target]]
    parts = []
    if numbers:
        parts.append(f"{_sum_with_error(numbers, target)}{noun} in {_pictures(numbers, rows)}")
    if guesses:
        are_the_rest = numbers and len(known) == len(rows)
        where = _the_other(len(guesses)) if are_the_rest else _pictures(guesses, rows)
        parts.append(f"at a guess {_sum_with_error(guesses, target)}{'' if numbers else noun} in {where}")
    return f"expect {', and '.join(parts)}" if parts else ""


def _pictures(some: Sequence[Values], rows: Sequence[Values]) -> str:
    """Say in how many of the pictures."""
    return "all" if len(some) == len(rows) else f"{len(some)} of {amount(len(rows), 'picture')}"


def _the_other(number: int) -> str:
    """Say in how many pictures that are all but those already named."""
    return "the other picture" if number == 1 else f"the other {number}"


def _sum_with_error(rows: Sequence[Values], target: str) -> str:
    """Write the sum of the expected numbers of a class in some pictures, with its error."""
    mean = sum(row["expected"][target] for row in rows)
    error = math.hypot(*(row["expected_error"][target] for row in rows))
    return number_with_error(mean, error)
