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
        """The fixation, the part of the picture, the level and the cells of a window."""
        # Four zeros stand for a window without a limit, since no limit ends at 0.
        return (*action.fixation, *(action.within or (0.0, 0.0, 0.0, 0.0)), action.level, *action.cells)

    def decode(self, row: Sequence[float]) -> Window:
        within: Any = tuple(row[3:7]) if row[5] > 0 else None
        cells: Any = tuple(map(int, row[8:12]))
        return Window((row[0], row[1], row[2]), int(row[7]), cells, within)

    def pack(self, looks: Sequence[WindowLook]) -> dict[str, Tensor]:
        """Convert looks to tensors for a file, gists without empty cells; a look without a gist has a scale of 0."""
        gists, kinds = [window_look.gist for window_look in looks], self.classes
        some = [look for look in gists if look is not None]
        frames = [[0, 0, 0] if look is None else [look.scale, *look.scores.shape[:2]] for look in gists]
        scores = torch.cat([torch.zeros(0, kinds), *(look.scores.flatten(0, 1) for look in some)])
        sizes = torch.cat([torch.zeros(0), *(look.size.flatten() for look in some)])
        found = torch.cat([torch.zeros(0, kinds, dtype=torch.bool), *(look.found.flatten(0, 1) for look in some)])
        full = (scores > 0).any(-1)
        return {
            **super().pack([window_look.detections for window_look in looks]),
            "cut": torch.cat([window_look.cut for window_look in looks]),
            "show": torch.stack([window_look.show for window_look in looks]),
            "gist.frames": torch.tensor(frames),
            "gist.cells": full.nonzero()[:, 0],
            "gist.scores": scores[full].float(),
            "gist.sizes": sizes[full].float(),
            "gist.found": found.flatten().nonzero()[:, 0],
        }

    def unpack(self, tensors: Mapping[str, Tensor], actions: Sequence[Window]) -> list[WindowLook]:
        """Convert the tensors of a file back to the looks at these windows."""
        frames, kinds = tensors["gist.frames"].tolist(), tensors["gist.scores"].shape[-1]
        counts = [rows * columns for _, rows, columns in frames]
        scores, size = torch.zeros(sum(counts), kinds), torch.zeros(sum(counts))
        found = torch.zeros(sum(counts) * kinds, dtype=torch.bool)
        cells = tensors["gist.cells"]
        scores[cells], size[cells], found[tensors["gist.found"]] = tensors["gist.scores"], tensors["gist.sizes"], True
        parts = scores.split(counts), size.split(counts), found.view(-1, kinds).split(counts)
        gists = [
            Gist(window.level, window.cells[:2], scale, *(part.unflatten(0, (rows, columns)).clone() for part in three))
            if scale
            else None
            for window, (scale, rows, columns), *three in zip(actions, frames, *parts, strict=True)
        ]
        seen, cut = super().unpack(tensors, actions), tensors["cut"].split(tensors["count"].tolist())
        return [WindowLook(*each) for each in zip(actions, seen, cut, tensors["show"], gists, strict=True)]


class StoredWindowLooks(WindowLooks):
    """Looks at the windows of one picture, each computed once. They have all their hints."""

    def __init__(self, eye: WindowEye, scenes: Scenes, index: int, store: WindowLookStore | None) -> None:
        self.lattice = Lattice.over(scenes.annotation(index).size, eye.detector.input_size, finest=eye.finest)

        def open_picture() -> Callable[[Window], WindowLook]:
            source = LiveWindowLooks(eye, eye.open(scenes[index].image))
            return lambda window: source.see([window])[0]

        # Files of looks have no hints of photographs.
        kept = store if self.lattice.levels > 1 else None
        self.looks = RememberedLooks(open_picture, kept, lambda: scenes.digest(index))

    def see(self, windows: Sequence[Window], *, hints: bool = True) -> list[WindowLook]:
        """The looks at windows, read from the store or computed."""
        return [self.looks(window) for window in windows]

    def save(self) -> None:
        """Store the looks at the picture if there are new ones."""
        self.looks.save()
