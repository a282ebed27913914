"""What subcommand check knows of fixations from the pictures in which they were made."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.errors import SemfovError
from semfov.human.content import CONTENT_PICTURES, FEWEST_PICTURES, content_suspicions
from semfov.runs.progress import task_bar


def suspicions_by_content(
    records: Sequence[Fixations], path_of: Callable[[str], Path], sizes: Mapping[str, tuple[int, int]], *, quiet: bool
) -> list[str]:
    """Compare fixations with where people look in their pictures (`semfov.human.content`).

    Args:
        records: the records.
        path_of: file of a picture by its name; raises `KeyError` where there is none.
        sizes: `(width, height)` of the pictures by their names.
        quiet: whether to hide the progress bar.

    Returns:
        The lines.
    """
    from semfov.agent import ActivePerception

    counts: dict[str, int] = {}
    for record in records:
        counts[record.picture] = counts.get(record.picture, 0) + len(record)
    # Pictures with most fixations tell most.
    names = sorted(counts, key=lambda name: (-counts[name], name))[:CONTENT_PICTURES]
    if len(names) < FEWEST_PICTURES:
        return []
    agent = ActivePerception.recommended()
    densities: dict[str, Tensor] = {}
    known: dict[str, tuple[int, int]] = {}
    with task_bar(len(names), "where people look", "picture", hidden=quiet) as bar:
        for name in names:
            with suppress(KeyError, SemfovError):  # a picture that is missing or damaged is named by its size
                densities[name] = agent.gaze(path_of(name)).cells
                known[name] = sizes[name]
            bar.update()
    return content_suspicions(records, densities, known)
