"""Foveal views to train on: the features of the network's untrained layers are computed once and stored."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.data.scene import Scenes
from semfov.detection.load import load_yolo
from semfov.errors import DataError, check_finite
from semfov.experiments.looks import one_thread
from semfov.experiments.parallel import available_cores, processor_seconds, run_tasks
from semfov.experiments.seeds import generator_for
from semfov.experiments.setup import check_sources, detector_options, make_scenes, prepare_worker
from semfov.experiments.store import SceneStore, looks_digest
from semfov.eye import Eye
from semfov.io.schema import Field, Schema
from semfov.sensor.foveation import Opened
from semfov.training.foveal_settings import FinetuneConfig
from semfov.training.tail import Tail

SOURCES = ("semfov.sensor.augmentation", "semfov.training.tail", __name__)
"""Modules that the views depend on, in addition to those that a look depends on."""


@dataclass(frozen=True)
class Views:
    """V views of one photograph, or of several photographs with canvases of the same size.

    Attributes:
        features: `(V, C, h, w)` for each layer whose output the tail reads, by the layer's number.
        canvas: `(width, height)` in pixels.
        boxes: boxes `(M, 4)` of the objects in each view, in canvas pixels.
        labels: classes `(M,)` of the objects in each view, 1..K.
    """

    features: dict[int, Tensor]
    canvas: tuple[int, int]
    boxes: Sequence[Tensor]
    labels: Sequence[Tensor]

    def __len__(self) -> int:
        return len(self.labels)

    @classmethod
    def join(cls, parts: Sequence[tuple[Views, int]]) -> Views:
        """Join single views of several photographs into one batch in single precision.

        Args:
            parts: views of a photograph, and the number of the view to take.

        Returns:
            The batch.
        """
        first = parts[0][0]
        features = {
            layer: torch.stack([views.features[layer][number] for views, number in parts]).float()
            for layer in first.features
        }
        boxes, labels = ([getattr(views, name)[number] for views, number in parts] for name in ("boxes", "labels"))
        return cls(features, first.canvas, boxes, labels)


class Viewer:
    """Look at photographs through `RandomFoveation`, and store the features that the tail of the network reads.

    Args:
        config: the settings.

    Attributes:
        detector: the detector, which runs in torch.
        eye: the sensor and the detector.
        tail: the layers to train.
        scenes: the photographs.
        store: store of the views.
    """

    def __init__(self, config: FinetuneConfig) -> None:
        self.config = config
        check_sources(config.data, config.detector)
        options = detector_options(config.detector) | {"runtime": "torch"}
        with one_thread():
            self.detector = load_yolo(config.detector.name, **options)
        detector = self.detector
        self.eye = Eye(config.sensor.make(), detector, reference=config.sensor.reference).eval().requires_grad_(False)
        self.tail = Tail(detector.network, config.depth)
        self.scenes: Scenes = make_scenes(config.data, detector.classes)
        names = ("depth", "fixations", "foveated", "seed")
        what = {"eye": self.eye.settings(), **{name: getattr(config, name) for name in names}}
        fields = {
            f"layer{number}": Field((config.fixations, *(f"{size}{number}" for size in "chw")), torch.float16)
            for number in self.tail.inputs
        }
        more = {
            "boxes": Field(("M", 4), torch.float32),
            "labels": Field(("M",), torch.int64, low=1, high=len(detector.classes)),
            "canvas": Field((2,), torch.int64, low=1),
            "seconds": Field((), torch.float64, low=0),
        }
        folder = (config.cache or config.out) / "features"
        self.store = SceneStore(folder, what, looks_digest(*SOURCES), Schema(fields | more))

    def see(self, index: int) -> None:
        """Compute the views of a photograph and store them."""
        started = processor_seconds()
        with one_thread(), torch.inference_mode():
            tensors = self._see(index)
        seconds = torch.tensor(processor_seconds() - started, dtype=torch.float64)
        self.store.write(self.scenes.digest(index), {**tensors, "seconds": seconds})

    def _see(self, index: int) -> dict[str, Tensor]:
        scene, annotation = self.scenes[index], self.scenes.annotation(index)
        view = self.eye.open(scene.image)
        canvases = self.foveated(view.canvas, view.state, scene.id)
        seen = [self.tail.features(canvas) for canvas in canvases.split(1)]
        features = {f"layer{number}": torch.cat([each[number] for each in seen]) for number in self.tail.inputs}
        for name, tensor in features.items():
            check_finite(tensor.half(), f"detector: {name} in half precision")
        scale, offset = (torch.tensor(pair * 2) for pair in (view.placement.scale, view.placement.offset))
        boxes = annotation.boxes * scale + offset
        size = torch.tensor(view.canvas.shape[:-3:-1])
        return {
            **{name: tensor.half() for name, tensor in features.items()},
            "boxes": boxes.float(),
            "labels": annotation.labels,
            "canvas": size,
        }

    def foveated(self, canvas: Tensor, opened: Opened, scene: int | str) -> Tensor:
        """Foveate a canvas at random points, which depend only on the seed in the settings and on the scene's id.

        Args:
            canvas: `(1, 3, h, w)`.
            opened: the sensor's state for the canvas, which has the width of the fovea.
            scene: id of the scene.

        Returns:
            Views `(F, 3, h, w)`.
        """
        from semfov.sensor import RandomFoveation

        sensor, config = self.config.sensor.make(), self.config
        augment = RandomFoveation(
            float(opened.sigma.mean()), sensor.levels, sensor.growth, sensor.convention, p=config.foveated
        )
        seed = generator_for("foveation", config.seed, scene).initial_seed()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            views: Tensor = augment(canvas.repeat(config.fixations, 1, 1, 1))
        return views

    def load(self, index: int) -> tuple[Views, float] | None:
        """Read the views of a photograph.

        Args:
            index: index of the photograph.

        Returns:
            The views in half precision and the processor seconds that they took, or None if they are not stored.
        """
        tensors = self.store.read(self.scenes.digest(index))
        if tensors is None:
            return None
        features = {number: tensors[f"layer{number}"] for number in self.tail.inputs}
        width, height = tensors["canvas"].tolist()
        count = self.config.fixations
        views = Views(features, (width, height), [tensors["boxes"]] * count, [tensors["labels"]] * count)
        return views, float(tensors["seconds"])


_process: dict[str, Viewer] = {}


def _prepare(config: FinetuneConfig) -> None:
    prepare_worker()
    _process["viewer"] = Viewer(config)


def _see(index: int) -> int:
    _process["viewer"].see(index)
    return index


def look(viewer: Viewer) -> tuple[list[Views], float]:
    """Read the views of all photographs, and compute the missing ones.

    Args:
        viewer: the viewer.

    Returns:
        The views in the order of the photographs, and the processor seconds that they took.

    Raises:
        DataError: views that were stored cannot be read.
    """
    found = [viewer.load(index) for index in range(len(viewer.scenes))]
    todo = [index for index, views in enumerate(found) if views is None]
    done = run_tasks(
        _see,
        todo,
        workers=viewer.config.workers or available_cores(),
        setup=_prepare,
        settings=(viewer.config,),
        title="looking",
        unit="photograph",
    )
    for index in done:
        found[index] = viewer.load(index)
    whole = [views for views in found if views is not None]
    if len(whole) < len(found):
        raise DataError(f"{viewer.store.folder}: stored views are missing or damaged; run the same command again")
    return [views for views, _ in whole], sum(seconds for _, seconds in whole)
