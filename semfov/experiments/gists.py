"""Gists of several looks as tensors for a file; only cells with a score above 0 are kept."""

from collections.abc import Sequence

import torch
from torch import Tensor

from semfov.io.schema import Field
from semfov.zoom.gist import Gist
from semfov.zoom.glances import Window


def gist_fields(kinds: int) -> dict[str, Field]:
    """Names, shapes and ranges of the tensors that hold the gists of `N` looks in a file.

    Args:
        kinds: number of classes.

    Returns:
        The fields by name.
    """
    return {
        "gist.frames": Field(("N", 3), torch.int64, low=0, high=1 << 20),
        "gist.counts": Field(("N", 2), torch.int64, low=0),
        "gist.cells": Field(("P",), torch.int32, low=0),
        "gist.scores": Field(("P", kinds), torch.float32, low=0, high=1),
        "gist.sizes": Field(("P",), torch.float32, low=0),
        "gist.found": Field(("Q",), torch.int32, low=0),
    }


def pack_gists(gists: Sequence[Gist | None], kinds: int) -> dict[str, Tensor]:
    """Pack gists into the tensors of `gist_fields`; a look without a gist has no cells.

    Args:
        gists: the gists of the looks.
        kinds: number of classes.

    Returns:
        The tensors by name.
    """
    frames, counts = torch.zeros(len(gists), 3, dtype=torch.int64), torch.zeros(len(gists), 2, dtype=torch.int64)
    cells, found = [torch.zeros(0, dtype=torch.int32)], [torch.zeros(0, dtype=torch.int32)]
    scores, sizes = [torch.zeros(0, kinds)], [torch.zeros(0)]
    for number, look in enumerate(gists):
        if look is None:
            continue
        full = (look.scores > 0).any(-1).flatten()
        cells.append(full.nonzero()[:, 0].int())
        scores.append(look.scores.flatten(0, 1)[full].float())
        sizes.append(look.size.flatten()[full].float())
        found.append(look.found.flatten().nonzero()[:, 0].int())
        frames[number] = torch.tensor([look.scale, *look.scores.shape[:2]])
        counts[number] = torch.tensor([len(cells[-1]), len(found[-1])])
    return {
        "gist.frames": frames,
        "gist.counts": counts,
        "gist.cells": torch.cat(cells),
        "gist.scores": torch.cat(scores),
        "gist.sizes": torch.cat(sizes),
        "gist.found": torch.cat(found),
    }


def unpack_gists(tensors: dict[str, Tensor], windows: Sequence[Window]) -> list[Gist | None]:
    """Unpack the tensors of `pack_gists`.

    Args:
        tensors: the tensors by name.
        windows: the windows of the looks.

    Returns:
        The gists of the looks; None for a look without one.
    """
    full, found = (column.tolist() for column in tensors["gist.counts"].unbind(1))
    parts = (tensors[f"gist.{name}"].split(full) for name in ("cells", "scores", "sizes"))
    told = zip(windows, tensors["gist.frames"].tolist(), *parts, tensors["gist.found"].split(found), strict=True)
    kinds = tensors["gist.scores"].shape[-1]
    gists: list[Gist | None] = []
    for window, (scale, rows, columns), cells, scores, sizes, seen in told:
        if not scale:
            gists.append(None)
            continue
        values, size = torch.zeros(rows * columns, kinds), torch.zeros(rows * columns)
        sure = torch.zeros(rows * columns * kinds, dtype=torch.bool)
        values[cells.long()], size[cells.long()], sure[seen.long()] = scores.float(), sizes.float(), True
        shape = rows, columns
        look = Gist(
            window.level, window.cells[:2], scale, values.view(*shape, -1), size.view(shape), sure.view(*shape, -1)
        )
        gists.append(look)
    return gists
