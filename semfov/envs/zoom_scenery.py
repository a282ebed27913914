"""The parts that environments with large pictures share: the pictures, and looks at their windows, each made once."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache, cached_property, partial
from pathlib import Path

import numpy as np

from semfov.data.large import open_large
from semfov.data.pictures import Pictures
from semfov.data.scene import Annotation, Scenes
from semfov.data.sources import PHOTOGRAPHS
from semfov.envs.scenery import Source, Surroundings
from semfov.errors import DataError, InputError, check, check_whole
from semfov.runs.config import DataConfig, DetectorConfig
from semfov.runs.window_looking import LEAST_CONFIDENCE, WindowLooking, WindowLookingConfig, found_in
from semfov.zoom.glances import Glance, overview
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge

_TRIES = 1000


class ZoomScenery(Surroundings):
    """Large pictures and an eye that zooms, which any number of environments can share; `open_zoom_scenery` makes one.

    Attributes:
        evidence: learned evidence by magnification.
        annotated: whether the objects in the pictures are annotated.
        episodes: targets of all searches of a picture.
    """

    def __init__(self, looking: WindowLooking, passes: int = 24, targets: Sequence[str | int] | None = None) -> None:
        super().__init__(looking.scenes, looking.eye, passes - 1, targets)
        self.evidence, self.annotated = looking.evidence, not isinstance(self.pictures, Pictures)
        # Looks are kept for as long as an environment uses this scenery.
        self.glances = cache(looking.glances)
        self.episodes = cache(self._list)

    @cached_property
    def windows(self) -> int:
        """Largest number of windows of any of the pictures."""
        pictures, eye = self.pictures, self.eye
        if isinstance(pictures, Pictures):
            sizes = [open_large(pictures.root / str(name)).size for name in pictures.ids]
        else:
            sizes = [pictures.annotation(index).size for index in range(len(pictures))]
        return max(len(Lattice.over(size, eye.detector.input_size, finest=eye.finest)) for size in set(sizes))

    def targets(self, scene: int) -> list[int]:
        """Classes that a picture may be searched for."""
        if self.annotated:
            return super().targets(scene)
        if self._chosen is None:
            raise InputError("targets: expected classes to search for in pictures without annotations, got none")
        return self._chosen

    def _list(self, scene: int) -> list[int]:
        """Targets of all searches of a picture: those that the look at the whole picture does not show already."""
        glances = self.glances(scene)
        first = glances.see([overview(glances.lattice)])[0]
        return [target for target in self.targets(scene) if not self.found([first], scene, target)]

    def draw(self, random: np.random.Generator, task: str, scene: int | None = None) -> tuple[int, int]:
        """Draw a picture and a target."""
        for _ in range(_TRIES):
            picture = int(random.integers(len(self.pictures))) if scene is None else scene
            if task != "search":
                if not self.annotated or len(self.pictures.annotation(picture).boxes):
                    return picture, 0
            elif targets := self.episodes(picture):
                return picture, targets[random.integers(len(targets))]
        raise DataError(
            "scenes: expected pictures with objects to look for, found none; give other pictures or targets"
        )

    def found(self, looks: Sequence[Glance], scene: int, target: int) -> bool:
        """Whether looks have found an object of the target class: by its box, or without annotations by the score."""
        if not self.annotated:
            return any(float(glance.show[target - 1]) >= LEAST_CONFIDENCE for glance in looks)
        every = self.pictures.annotation(scene)
        there = every.labels == target
        objects = Annotation(every.boxes[there], every.labels[there], every.crowd[there], every.size)
        return bool(found_in(looks, objects, target).any())

    def share(self, looks: Sequence[Glance], scene: int) -> float:
        """Fraction of the objects that looks have found."""
        if not self.annotated:
            return float(len(merge(looks, None, score=LEAST_CONFIDENCE)))
        return float(found_in(looks, self.pictures.annotation(scene)).float().mean())


class _PictureLooking(WindowLooking):
    """Given large pictures, or those of a folder without annotations."""

    def __init__(self, config: WindowLookingConfig, scenes: Source) -> None:
        self._chosen = scenes
        super().__init__(config)

    def open_scenes(self, classes: tuple[str, ...]) -> Scenes:
        """The given pictures, or all pictures of the folder."""
        if self._chosen is not None and not isinstance(self._chosen, str | Path):
            return self._chosen
        if self._chosen is None or self.config.data.annotations is not None:
            return super().open_scenes(classes)
        root = Path(self._chosen)
        if not root.is_dir():
            raise DataError(f"scenes: no such folder: {root}; check the path")
        names = [path.name for path in root.iterdir() if path.suffix.lower() in PHOTOGRAPHS]
        if not names:
            raise DataError(f"scenes: expected pictures ({', '.join(PHOTOGRAPHS)}) in {root}, found none")
        return Pictures(root, names, classes)


def open_zoom_scenery(
    scenes: Source = None,
    annotations: str | Path | None = None,
    *,
    count: int | None = None,
    mosaics: int | None = None,
    tiles: tuple[int, int] = (4, 4),
    targets: Sequence[str | int] | None = None,
    detector: str = "yolov3-tiny",
    weights: str | Path | None = None,
    passes: int = 24,
    seed: int = 0,
    cache: str | Path | None = None,
    store: bool = True,
) -> ZoomScenery:
    """Open large pictures for environments.

    Args:
        scenes: embedded scenes (None), a folder of large pictures, or any `Scenes` with the detector's classes.
        annotations: COCO-format instances file of the folder. Without one the objects in the pictures are unknown, and
            those that the detector shows with a score of 0.3 count.
        count: use only the first scenes, this many (None: all of a folder, 8 embedded ones).
        mosaics: number of mosaics to compose of the scenes; 0 takes the scenes as they are (None: 8 of embedded scenes,
            otherwise 0).
        tiles: number of photographs in a row and in a column of a mosaic.
        targets: classes to search for, by name or index; None takes all that a picture allows.
        detector: name of a detector for which evidence by magnification is shipped.
        weights: file with the detector's weights.
        passes: largest number of looks of an episode, the first one at the whole picture included.
        seed: of embedded scenes and mosaics.
        cache: folder for stored looks (None: the user's cache).
        store: whether looks are kept on disk.

    Returns:
        The scenery, to be shared by environments.

    Raises:
        InputError: an argument is out of range, or the scenes have other classes than the detector.
        DataError: pictures, annotations or weights are missing or damaged.

    Example::

        scenery = open_zoom_scenery("aerial/", targets=["person"], detector="yolox-nano")
        env = ZoomEnv("search", scenery, belief=True)
    """
    arguments = {**locals()}
    check_whole(passes, "passes", 2, 100_000)
    folder = Path(scenes) if isinstance(scenes, str | Path) else None
    data = DataConfig(
        None if annotations is None else folder,
        None if annotations is None else Path(annotations),
        count,
        min_instances=0,
        max_target_area=0.2 if annotations is not None else None,
        scene_seed=seed,
    )
    config = WindowLookingConfig(
        data=data,
        detector=DetectorConfig(detector, None if weights is None else Path(weights)),
        mosaics=(8 if scenes is None else 0) if mosaics is None else mosaics,
        columns=tiles[0],
        rows=tiles[1],
        seed=seed,
        cache=None if cache is None else Path(cache),
        store=store,
    )
    looking = _PictureLooking(config, scenes)
    classes, names = looking.scenes.classes, looking.eye.detector.classes
    check(classes == names, "scenes", "the classes of the detector", f"{len(classes)} others")
    scenery = ZoomScenery(looking, passes, targets)
    scenery.opened = partial(open_zoom_scenery, **arguments)
    return scenery
