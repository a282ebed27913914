"""Looks at windows of large pictures, kept on disk."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from torch import Tensor

from semfov.agents.windows import window_eye
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation, Scenes
from semfov.errors import DataError
from semfov.io.ranges import Range, Seed, Side, Whole
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.runs.config import DataConfig, DetectorConfig, WorkConfig
from semfov.runs.scene_run import store_folder
from semfov.runs.setup import make_detector, make_scenes
from semfov.runs.zoom_store import StoredWindowLooks, WindowLookStore
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import Cut
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import merge

TileSize = Annotated[int, Range(16, 16_384)]  # side of a part of a picture in pixels


@dataclass(frozen=True)
class WindowLookingConfig(WorkConfig):
    """Large pictures, and an eye that looks at windows of them.

    Args:
        mosaics: number of mosaics to compose from the photographs; 0 uses the photographs as they are.
        columns: number of photographs in a row of a mosaic.
        rows: number of photographs in a column of a mosaic.
        tile: width in pixels of a photograph's slot in a mosaic; the height is three quarters of it.
        cut: what to do with boxes at a window's border.
        model: fitted evidence by magnification, by name or file (None: the one shipped for the detector).
        seed: random seed of mosaics.
        store: keep looks on disk; false computes them anew in each run (the result is the same).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(name="yolox-nano"))
    mosaics: Whole = 100
    columns: Side = 4
    rows: Side = 4
    tile: TileSize = 640
    cut: Cut = "keep"
    model: str | None = None
    seed: Seed = 0
    store: bool = True


class WindowLooking:
    """Large pictures, an eye that looks at their windows, and learned evidence; the detections are stored.

    Attributes:
        config: the settings.
        eye: looks at windows.
        evidence: evidence by magnification for its detector.
        scenes: the pictures: mosaics of photographs, or photographs as they are.
        store: the looks on disk.
    """

    config: WindowLookingConfig
    scenes: Scenes

    def __init__(self, config: WindowLookingConfig) -> None:
        self.config = config
        detector = make_detector(config.detector)
        self.evidence = GlimpseEvidence.from_pretrained(config.model or detector.name).requires_grad_(False)
        self.eye = window_eye(detector, self.evidence, cut=config.cut).eval().requires_grad_(False)
        self.evidence.check_compatible(self.eye.settings())
        photographs = self.open_scenes(detector.classes)
        if not len(photographs):
            raise DataError("data: the settings select no photograph; lower data.min_instances or raise data.limit")
        self.scenes = photographs
        if config.mosaics:
            tile = config.tile, config.tile * 3 // 4
            self.scenes = Mosaics(
                photographs, config.columns, config.rows, tile=tile, count=config.mosaics, seed=config.seed
            )
        folder = store_folder(config.cache) / "glances"
        self.store = WindowLookStore(folder, self.eye.settings(), len(detector.classes))

    def open_scenes(self, classes: tuple[str, ...]) -> Scenes:
        """Open the photographs; a subclass may open others."""
        return make_scenes(self.config.data, classes)

    def looks_at(self, index: int) -> StoredWindowLooks:
        """Open the looks at a picture."""
        return StoredWindowLooks(self.eye, self.scenes, index, self.store if self.config.store else None)


def found_in(looks: Sequence[WindowLook], annotation: Annotation, target: int | None = None) -> Tensor:
    """Tell which objects looks have found: a merged box has a score of 0.1 or more and an IoU of 0.5 or more.

    Args:
        looks: looks at a picture.
        annotation: its M objects.
        target: class that they looked for, 1..K; None for all.

    Returns:
        `(M,)` boolean.
    """
    objects = merge(looks, target, score=DETECTION_SCORE)
    hits = (box_iou(objects.boxes, annotation.boxes) >= SAME_OBJECT_IOU) & (
        objects.labels[:, None] == annotation.labels
    )
    return hits.any(0)
