"""The part of subcommand `check` that compares fixations with their pictures."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from semfov.agents.picture import OpenedPicture
from semfov.cli.options import DEFAULT_DETECTOR
from semfov.data.classes import amount
from semfov.data.fixations import Fixations
from semfov.detection.load import load_detector
from semfov.errors import SemfovError
from semfov.human.content import CONTENT_PICTURES, FEWEST_PICTURES, content_suspicions
from semfov.paths.gaze import GazePrediction
from semfov.runs.progress import task_bar

_DAMAGED_NAMED = 3  # largest number of damaged pictures that are named


def suspicions_by_content(
    records: Sequence[Fixations], path_of: Callable[[str], Path], sizes: Mapping[str, tuple[int, int]], *, quiet: bool
) -> list[str]:
    """Compare fixations with the predicted density of fixations in their pictures (`semfov.human.content`).

    Args:
        records: the records.
        path_of: file of a picture by its name; raises `KeyError` where there is none.
        sizes: `(width, height)` of the pictures by their names; without those that are missing or damaged.
        quiet: whether to hide the progress bar.

    Returns:
        The lines.
    """
    counts: Counter[str] = Counter()
    for record in records:
        if record.picture in sizes:
            counts[record.picture] += len(record)
    # Pictures with most fixations tell most.
    names = sorted(counts, key=lambda name: (-counts[name], name))[:CONTENT_PICTURES]
    if len(names) < FEWEST_PICTURES:
        return []
    detector = load_detector(DEFAULT_DETECTOR)
    densities: dict[str, Tensor] = {}
    picture_sizes: dict[str, tuple[int, int]] = {}
    errors: list[SemfovError] = []
    with task_bar(len(names), "where people look", "picture", hidden=quiet) as bar:
        for name in names:
            try:
                image, size = OpenedPicture.of(path_of(name)).viewed(torch.zeros(1))
            except SemfovError as error:  # its head tells a size, but the rest cannot be decoded
                errors.append(error)
            else:
                densities[name] = GazePrediction.of(detector, image, size=size).cells
                picture_sizes[name] = sizes[name]
            bar.update()
    return damage_lines(errors) + content_suspicions(records, densities, picture_sizes)


def damage_lines(errors: Sequence[SemfovError]) -> list[str]:
    """Make lines that say why the first pictures with an error cannot be opened."""
    more = len(errors) - _DAMAGED_NAMED
    rest = [f"{amount(more, 'more picture')} cannot be opened"] if more > 0 else []
    return [*map(str, errors[:_DAMAGED_NAMED]), *rest]
