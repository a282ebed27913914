"""Stores the looks and closer looks that searches of a photograph have made, so that each is computed only once."""

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.experiments.store import SceneStore, grid_settings, looks_digest, pack, unpack_each
from semfov.io.schema import Field, Schema

Box = tuple[float, ...]


class PhotographStore(SceneStore):
    """Detections from some cells of photographs, and of closer looks at some boxes, on disk.

    Args:
        folder: folder of the store.
        settings: `Eye.settings()`.
        columns: number of columns of the grid.
        rows: number of rows of the grid.
        classes: number of the detector's classes.
    """

    def __init__(self, folder: Path, settings: Mapping[str, object], columns: int, rows: int, classes: int) -> None:
        what = {"settings": settings, **grid_settings(columns, rows)}
        schema = Schema(
            {
                "cells": Field(("N",), torch.int64, low=0),
                "examined": Field(("E", 4), torch.float32),
                "count": Field(("L",), torch.int64, low=0),
                "boxes": Field(("M", 4), torch.float32),
                "scores": Field(("M", classes + 1), torch.float32, low=0, high=1),
            }
        )
        super().__init__(folder, what, looks_digest(__name__), schema)

    def load(self, digest: str) -> tuple[dict[int, Detections], dict[Box, Detections]]:
        """Read the looks at a photograph.

        Args:
            digest: sha256 of what its pixels depend on.

        Returns:
            The looks by cell, and the closer looks by examined box; empty if they are missing or incomplete.
        """
        tensors = self.read(digest)
        looks = None if tensors is None else unpack_each(tensors)
        if tensors is None or looks is None:
            return {}, {}
        cells, examined = tensors["cells"].tolist(), tensors["examined"].tolist()
        if len(looks) != len(cells) + len(examined):
            return {}, {}
        closer = zip(map(tuple, examined), looks[len(cells) :], strict=True)
        return dict(zip(cells, looks[: len(cells)], strict=True)), dict(closer)

    def save(self, digest: str, looks: Mapping[int, Detections], closer: Mapping[Box, Detections]) -> None:
        """Store the looks at a photograph.

        Args:
            digest: sha256 of what its pixels depend on.
            looks: the looks by cell; at least one.
            closer: the closer looks by examined box.
        """
        together = Detections.stack([*looks.values(), *closer.values()])
        examined = torch.tensor([*closer], dtype=torch.float32).reshape(-1, 4)
        tensors: dict[str, Tensor] = {"cells": torch.tensor([*looks]), "examined": examined, **pack(together)}
        self.write(digest, tensors)
