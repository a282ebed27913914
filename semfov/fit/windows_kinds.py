"""Kinds of large pictures to fit on, beside mosaics of many photographs."""

from typing import Literal, get_args

from semfov.data.mosaics import Mosaics
from semfov.data.scattered import Scattered
from semfov.data.scene import Scenes

PictureKind = Literal["few", "many", "one class", "photographs", "objects"]
"""Mosaics of 3 × 3 photographs; of 12 × 12 of half the size; of 8 × 6 that share a class; photographs, and single
objects of few classes, scattered over one ground."""

PICTURE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind)


def compose_pictures(kind: PictureKind, scenes: Scenes, count: int, seed: int, tile: int = 480) -> Scenes:
    """Compose pictures of a kind."""
    seed += 10 + PICTURE_KINDS.index(kind)
    half, ground = (tile // 2, tile * 3 // 8), (8 * tile, 9 * tile // 2)
    match kind:
        case "few":
            return Mosaics(scenes, 3, 3, tile=(tile, tile * 3 // 4), count=count, seed=seed)
        case "many":
            return Mosaics(scenes, 12, 12, tile=half, count=count, seed=seed)
        case "one class":
            return Mosaics(scenes, 8, 6, tile=half, alike=True, count=count, seed=seed)
        case "photographs":
            sides = tile // 5, tile
            return Scattered(scenes, whole=True, size=ground, sides=sides, most=8, count=count, seed=seed)
        case "objects":
            return Scattered(scenes, size=ground, sides=(tile // 15, tile // 3), count=count, seed=seed)
