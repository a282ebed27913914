"""From settings to objects: scenes, eye, models."""

from __future__ import annotations

import json
import logging
import multiprocessing
from pathlib import Path
from typing import Any

import torch

from semfov.belief import ContextPrior, MapEvidence, TargetEvidence
from semfov.data.scene import Scenes
from semfov.detection.detector import Detector
from semfov.detection.load import check_detector, load_detector
from semfov.errors import DataError, InputError, check
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.looks import one_thread
from semfov.eye import Eye
from semfov.gaze.learned import LearnedGaze
from semfov.gaze.templates import ClassTemplates
from semfov.io.compatibility import learned_for, recommended
from semfov.io.files import check_regular
from semfov.io.shipped import shipped_model
from semfov.observation.foveal import FovealObservationModel
from semfov.presets import PUBLISHED_SENSORS
from semfov.sensor import Foveation
from semfov.zoom.eye import ZoomEye


def check_sources(data: DataConfig, detector: DetectorConfig) -> None:
    """Raise an error where photographs, annotations or a detector are not there, before any of them is loaded."""
    check_data(data)
    check_detector(detector.name)


def check_data(data: DataConfig) -> None:
    """Raise an error unless photographs and annotations are there, or neither is asked for."""
    if (data.root is None) != (data.annotations is None):
        raise InputError("data: expected both data.root and data.annotations, or neither for the embedded scenes")
    if data.root is not None and not data.root.is_dir():
        raise DataError(f"data.root: no such folder: {data.root}; check the path")
    if data.annotations is not None and not data.annotations.exists():
        raise DataError(f"data.annotations: no such file: {data.annotations}; check the path")


def make_scenes(data: DataConfig, classes: tuple[str, ...]) -> Scenes:
    """The scenes to search: photographs where a root is given, else embedded ones."""
    check_data(data)
    if data.root is None or data.annotations is None:
        from semfov.data.scenes import EmbeddedScenes

        return EmbeddedScenes(classes, count=data.limit or 8, seed=data.scene_seed)
    from semfov.data.coco import CocoScenes

    return CocoScenes(
        data.root,
        data.annotations,
        classes,
        min_instances=data.min_instances,
        ids=None if data.ids is None else read_ids(data.ids),
        max_target_area=data.max_target_area,
        limit=data.limit,
    )


def split_photographs(data: DataConfig, classes: tuple[str, ...], every: int) -> tuple[Scenes, Scenes]:
    """All photographs but every n-th, and these; of embedded scenes two sets.

    Raises:
        InputError: there are too few to split.
    """
    check_data(data)
    if data.root is None or data.annotations is None:
        from semfov.data.scenes import EmbeddedScenes

        count = data.limit or 16
        return (
            EmbeddedScenes(classes, count=count, seed=data.scene_seed),
            EmbeddedScenes(classes, count=count, seed=data.scene_seed + 1),
        )
    from semfov.data.coco import CocoScenes

    selection: dict[str, Any] = {"min_instances": data.min_instances, "max_target_area": data.max_target_area}
    ids = CocoScenes(data.root, data.annotations, classes, limit=data.limit, **selection).ids
    check(len(ids) >= 2 * every, "data", f"at least {2 * every} photographs", len(ids))
    kept = [name for number, name in enumerate(ids) if number % every]
    return (
        CocoScenes(data.root, data.annotations, classes, ids=kept, **selection),
        CocoScenes(data.root, data.annotations, classes, ids=ids[::every], **selection),
    )


def read_ids(path: Path) -> list[str]:
    """Ids of photographs, one a line."""
    check_regular(path)
    try:
        return path.read_text(encoding="utf-8").split()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as a list of ids ({error})") from None


def make_detector(detector: DetectorConfig) -> Detector:
    """The detector that the settings name."""
    # A session of onnxruntime keeps the threads that it is opened with.
    with one_thread():
        return load_detector(detector.name, **detector_options(detector))


def detector_options(detector: DetectorConfig) -> dict[str, Any]:
    """Options of `semfov.load_detector` that settings stand for."""
    onnx = detector.name.endswith(".onnx")
    if detector.head is not None and not onnx:
        raise InputError(f"detector.head: expected none, for {detector.name!r} is no ONNX model of your own")
    options: dict[str, Any] = {
        "threshold": detector.threshold,
        "iou": detector.iou,
        "limit": detector.limit,
    }
    for name in ("background", "weights", "classes", "head"):
        if getattr(detector, name) is not None:
            options[name] = getattr(detector, name)
    if detector.stride != "auto":
        options["stride"] = detector.stride
    if detector.input_size is not None:
        options["input_size"] = detector.input_size
    if detector.runtime != "auto":
        options["runtime"] = detector.runtime
    return options


def make_eye(detector: DetectorConfig, sensor: SensorConfig) -> Eye:
    """The foveal sensor and the detector behind it."""
    model = make_detector(detector)
    return Eye(sensor.make(), model, reference=sensor.reference).eval().requires_grad_(False)


def fovea_of(eye: Eye) -> Foveation:
    """The foveal sensor of an eye: fitted models are shipped for no other."""
    sensor = eye.sensor
    if not isinstance(sensor, Foveation):
        raise InputError(f"sensor: expected a Foveation, which models are named after, got {type(sensor).__name__}")
    return sensor


def make_observation(name: str | None, eye: Eye) -> FovealObservationModel:
    """The observation model of that name, or the one for this eye; checked to belong to detector and class list."""
    own = recommended(eye.detector.name, float(fovea_of(eye).growth))
    model = FovealObservationModel.from_pretrained(name or shipped_model(FovealObservationModel, own, "MODEL"))
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)


def make_zoom_observation(name: str | None, eye: ZoomEye) -> FovealObservationModel | None:
    """The observation model by magnification of that name, or the one for this eye; None where none is shipped."""
    own = f"{eye.detector.name}-zoom"
    if name is None and not (FovealObservationModel.shipped / f"{own}.safetensors").is_file():
        return None
    model = FovealObservationModel.from_pretrained(name or own)
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)


def published_model(detector: DetectorConfig, sensor: SensorConfig) -> str | None:
    """Observation model of maximum likelihood for detector and sensor; None where none is shipped."""
    name = f"{detector.name}-{sensor.name}"
    shipped = (FovealObservationModel.shipped / f"{name}.safetensors").is_file()
    return name if sensor.name in PUBLISHED_SENSORS and shipped else None


def make_target_evidence(name: str | None, eye: Eye) -> TargetEvidence:
    """The learned evidence for a target of that name, or the one for this eye; checked to belong to it."""
    own = learned_for(eye.detector.name, float(fovea_of(eye).growth))
    model = TargetEvidence.from_pretrained(name or shipped_model(TargetEvidence, own, "MODEL"))
    model.check_compatible(eye.settings())
    return model.requires_grad_(False)


def make_map_evidence(name: str | None, eye: Eye) -> MapEvidence:
    """The learned map of that name, or the one for this eye; checked to belong to it."""
    own = learned_for(eye.detector.name, float(fovea_of(eye).growth))
    model = MapEvidence.from_pretrained(name or shipped_model(MapEvidence, own, "MODEL"))
    model.check_compatible(eye.settings())
    return model.requires_grad_(False)


def make_learned_gaze(name: str | None, eye: Eye) -> LearnedGaze:
    """The learned gaze policy of that name, or the one for this detector; checked to belong to it."""
    gaze = LearnedGaze.from_pretrained(name or eye.detector.name)
    gaze.check_compatible(eye.settings())
    return gaze.requires_grad_(False)


def make_templates(name: str | None, eye: Eye) -> ClassTemplates:
    """The class templates of that name, or those for this detector; checked to belong to it."""
    model = ClassTemplates.from_pretrained(name or eye.detector.name)
    model.check_eye(eye.settings(), eye.detector.classes)
    return model


def make_context(name: str, eye: Eye | ZoomEye) -> ContextPrior:
    """The context of searches, checked to know the detector's classes."""
    prior = ContextPrior.from_pretrained(name)
    prior.check_compatible(eye.detector.classes)
    return prior.requires_grad_(False)


def plain(settings: dict[str, Any]) -> Any:
    """Settings as JSON and YAML have them: paths as text, tuples as lists."""
    return json.loads(json.dumps(settings, default=str))


def prepare_worker() -> None:
    """One thread a process, so that detections do not depend on how many share the work; and no repeated notices."""
    torch.set_num_threads(1)
    # Freeing one large block raises glibc's threshold for handing memory back, or it would do so after every look.
    torch.empty(31 << 20, dtype=torch.uint8)
    if multiprocessing.parent_process() is not None:
        logging.getLogger("semfov").setLevel(logging.ERROR)
