"""Stores looks at the windows of pictures, so that each is computed only once."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.detection.load import load_detector
from semfov.io.schema import Field
from semfov.runs.store import DetectionStore, RememberedLooks
from semfov.zoom.eye import WindowEye
from semfov.zoom.glances import Glance, Glances, LiveGlances, Window
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice


class GlanceStore(DetectionStore):
    """Glances at pictures by window, on disk."""

    width = 12
    sources = (Glances.__module__, load_detector.__module__, "semfov.data.images", "semfov.data.large", __name__)
    """Modules that turn a large picture into glances; all modules that they import count, too."""

    def __init__(self, folder: Path, settings: Mapping[str, object], classes: int) -> None:
        self.classes = classes
        self.more = {
            "cut": Field(("M",), torch.bool),
            "show": Field(("N", classes), torch.float32, low=0, high=1),
            "gist.frames": Field(("N", 3), torch.int64, low=0, high=1 << 20),
            "gist.counts": Field(("N", 2), torch.int64, low=0),
            "gist.cells": Field(("P",), torch.int32, low=0),
            "gist.scores": Field(("P", classes), torch.float32, low=0, high=1),
            "gist.sizes": Field(("P",), torch.float32, low=0),
            "gist.found": Field(("Q",), torch.int32, low=0),
        }
        super().__init__(folder, {"settings": settings}, self.sources, classes + 1)

    def encode(self, action: Window) -> Sequence[float]:
        """The fixation, the part of the picture, the level and the cells of a window."""
        # Four zeros stand for a window without a limit, since no limit ends at 0.
        return (*action.fixation, *(action.within or (0.0, 0.0, 0.0, 0.0)), action.level, *action.cells)

    def decode(self, row: Sequence[float]) -> Window:
        """A window."""
        within: Any = tuple(row[3:7]) if row[5] > 0 else None
        cells: Any = tuple(map(int, row[8:12]))
        return Window((row[0], row[1], row[2]), int(row[7]), cells, within)

    def pack(self, looks: Sequence[Glance]) -> dict[str, Tensor]:
        """Convert glances to tensors for a file."""
        return {
            **super().pack([glance.detections for glance in looks]),
            "cut": torch.cat([glance.cut for glance in looks]),
            "show": torch.stack([glance.show for glance in looks]),
            **_pack_gists([glance.gist for glance in looks], self.classes),
        }

    def unpack(self, tensors: Mapping[str, Tensor], actions: Sequence[Window]) -> list[Glance]:
        """Convert the tensors of a file back to the glances at these windows."""
        seen = super().unpack(tensors, actions)
        cut, gists = tensors["cut"].split(tensors["count"].tolist()), _unpack_gists(tensors, actions)
        return [Glance(*each) for each in zip(actions, seen, cut, tensors["show"], gists, strict=True)]


class StoredGlances(Glances):
    """Looks at the windows of one picture, each computed once. They have all their hints."""

    def __init__(self, eye: WindowEye, scenes: Scenes, index: int, store: GlanceStore | None) -> None:
        self.lattice = Lattice.over(scenes.annotation(index).size, eye.detector.input_size, finest=eye.finest)

        def open_picture() -> Callable[[Window], Glance]:
            glances = LiveGlances(eye, eye.open(scenes[index].image))
            return lambda window: glances.see([window])[0]

        # Files of looks have no hints of photographs.
        kept = store if self.lattice.levels > 1 else None
        self.looks = RememberedLooks(open_picture, kept, lambda: scenes.digest(index))

    def see(self, windows: Sequence[Window], *, hints: bool = True) -> list[Glance]:
        """The looks at windows, read from the store or computed."""
        return [self.looks(window) for window in windows]

    def save(self) -> None:
        """Store the looks at the picture if there are new ones."""
        self.looks.save()


def _pack_gists(gists: Sequence[Gist | None], kinds: int) -> dict[str, Tensor]:
    """Pack gists into tensors for a file; a look without a gist has no cells."""
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


def _unpack_gists(tensors: Mapping[str, Tensor], windows: Sequence[Window]) -> list[Gist | None]:
    """Unpack the tensors of `_pack_gists`."""
    cell_counts, found_counts = (column.tolist() for column in tensors["gist.counts"].unbind(1))
    looks = zip(
        windows,
        tensors["gist.frames"].tolist(),
        tensors["gist.cells"].split(cell_counts),
        tensors["gist.scores"].split(cell_counts),
        tensors["gist.sizes"].split(cell_counts),
        tensors["gist.found"].split(found_counts),
        strict=True,
    )
    kinds = tensors["gist.scores"].shape[-1]
    gists: list[Gist | None] = []
    for window, (scale, rows, columns), cells, scores, sizes, found in looks:
        if not scale:
            gists.append(None)
            continue
        values, size = torch.zeros(rows * columns, kinds), torch.zeros(rows * columns)
        sure = torch.zeros(rows * columns * kinds, dtype=torch.bool)
        values[cells.long()], size[cells.long()], sure[found.long()] = scores.float(), sizes.float(), True
        shape = rows, columns
        look = Gist(
            window.level, window.cells[:2], scale, values.view(*shape, -1), size.view(shape), sure.view(*shape, -1)
        )
        gists.append(look)
    return gists
