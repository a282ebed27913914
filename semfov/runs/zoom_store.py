"""Stores looks at the windows of pictures, so that each is computed only once."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.detection.load import load_detector
from semfov.io.schema import Field
from semfov.runs.store import DetectionStore, RememberedLooks
from semfov.zoom import Lattice, WindowEye
from semfov.zoom.hints import Gist
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook, WindowLooks


class WindowLookStore(DetectionStore):
    """Looks at pictures by window, on disk."""

    width = 12
    sources = (WindowLooks.__module__, load_detector.__module__, "semfov.data.images", "semfov.data.large", __name__)
    """Modules that turn a large picture into looks; all modules that they import count, too."""

    def __init__(self, folder: Path, settings: Mapping[str, object], classes: int) -> None:
        self.classes = classes
        self.more = {
            "cut": Field(("M",), torch.bool),
            "show": Field(("N", classes), torch.float32, low=0, high=1),
            "gist.frames": Field(("N", 3), torch.int64, low=0, high=1 << 20),
            "gist.cells": Field(("P",), torch.int64, low=0),
            "gist.scores": Field(("P", classes), torch.float32, low=0, high=1),
            "gist.sizes": Field(("P",), torch.float32, low=0),
            "gist.found": Field(("Q",), torch.int64, low=0),
        }
        super().__init__(folder, {"settings": settings}, self.sources, classes + 1)

    def encode(self, action: Window) -> Sequence[float]:
        """Write a window as numbers: the fixation, the part of the picture, the level and the cells."""
        # Four zeros stand for a window without a limit, since no limit ends at 0.
        return (*action.fixation, *(action.within or (0.0, 0.0, 0.0, 0.0)), action.level, *action.cells)

    def decode(self, row: Sequence[float]) -> Window:
        """Read a window from the numbers of `encode`."""
        x, y, magnification, left, top, right, bottom, level, *cells = row
        first_column, first_row, last_column, last_row = map(int, cells)
        within = (left, top, right, bottom) if right > 0 else None
        return Window((x, y, magnification), int(level), (first_column, first_row, last_column, last_row), within)

    def pack(self, looks: Sequence[WindowLook]) -> dict[str, Tensor]:
        """Convert looks to tensors for a file."""
        return {
            **super().pack([look.detections for look in looks]),
            "cut": torch.cat([look.cut for look in looks]),
            "show": torch.stack([look.show for look in looks]),
            **_pack_gists([look.gist for look in looks], self.classes),
        }

    def unpack(self, tensors: Mapping[str, Tensor], actions: Sequence[Window]) -> list[WindowLook]:
        """Convert the tensors of a file back to the looks at these windows."""
        detections = super().unpack(tensors, actions)
        cut = tensors["cut"].split(tensors["count"].tolist())
        gists = _unpack_gists(tensors, actions)
        return [
            WindowLook(window, detections[number], cut[number], tensors["show"][number], gists[number])
            for number, window in enumerate(actions)
        ]


def _pack_gists(gists: Sequence[Gist | None], classes: int) -> dict[str, Tensor]:
    """Convert the gists of looks to tensors for a file.

    The cells of all gists follow one another; scores and sizes of cells without a score are left out.

    Args:
        gists: the gists; None for a look without one, whose scale is written as 0.
        classes: number of classes K.

    Returns:
        Tensors by name.
    """
    frames = []
    scores = [torch.zeros(0, classes)]
    sizes = [torch.zeros(0)]
    found = [torch.zeros(0, classes, dtype=torch.bool)]
    for gist in gists:
        if gist is None:
            frames.append([0, 0, 0])
            continue
        rows, columns = gist.scores.shape[:2]
        frames.append([gist.scale, rows, columns])
        scores.append(gist.scores.flatten(0, 1))
        sizes.append(gist.size.flatten())
        found.append(gist.found.flatten(0, 1))
    all_scores = torch.cat(scores)  # (cells, K)
    has_score = (all_scores > 0).any(-1)
    return {
        "gist.frames": torch.tensor(frames),
        "gist.cells": has_score.nonzero()[:, 0],
        "gist.scores": all_scores[has_score].float(),
        "gist.sizes": torch.cat(sizes)[has_score].float(),
        "gist.found": torch.cat(found).flatten().nonzero()[:, 0],
    }


def _unpack_gists(tensors: Mapping[str, Tensor], windows: Sequence[Window]) -> list[Gist | None]:
    """Convert the tensors of `_pack_gists` back to the gists of looks at windows."""
    frames = tensors["gist.frames"].tolist()
    classes = tensors["gist.scores"].shape[-1]
    counts = [rows * columns for _, rows, columns in frames]
    scores = torch.zeros(sum(counts), classes)
    sizes = torch.zeros(sum(counts))
    found = torch.zeros(sum(counts) * classes, dtype=torch.bool)
    scores[tensors["gist.cells"]] = tensors["gist.scores"]
    sizes[tensors["gist.cells"]] = tensors["gist.sizes"]
    found[tensors["gist.found"]] = True
    scores_of = scores.split(counts)
    sizes_of = sizes.split(counts)
    found_of = found.view(-1, classes).split(counts)
    gists: list[Gist | None] = []
    for number, (window, (scale, rows, columns)) in enumerate(zip(windows, frames, strict=True)):
        if not scale:
            gists.append(None)
            continue
        cells = (part[number].unflatten(0, (rows, columns)).clone() for part in (scores_of, sizes_of, found_of))
        gists.append(Gist(window.level, window.cells[:2], scale, *cells))
    return gists


class StoredWindowLooks(WindowLooks):
    """Looks at the windows of one picture, each computed once. They have all their hints."""

    def __init__(self, eye: WindowEye, scenes: Scenes, index: int, store: WindowLookStore | None) -> None:
        self.lattice = Lattice.over(scenes.annotation(index).size, eye.detector.input_size, finest=eye.finest)

        def open_picture() -> Callable[[Window], WindowLook]:
            source = LiveWindowLooks(eye, eye.open(scenes[index].image))
            return lambda window: source.see([window])[0]

        # Files of looks have no hints of photographs.
        store = store if self.lattice.levels > 1 else None
        self.looks = RememberedLooks(open_picture, store, lambda: scenes.digest(index))

    def see(self, windows: Sequence[Window], *, hints: bool = True) -> list[WindowLook]:
        """Look at windows, or read the looks from the store."""
        return [self.looks(window) for window in windows]

    def save(self) -> None:
        """Store the looks at the picture if there are new ones."""
        self.looks.save()
