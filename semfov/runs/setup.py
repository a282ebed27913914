"""Makes scenes, detector, eye and models from settings."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from semfov.belief import Verification
from semfov.data import CocoScenes, EmbeddedScenes, Scenes
from semfov.detection.detector import Detector
from semfov.detection.load import check_detector, load_detector
from semfov.errors import DataError, InputError, check
from semfov.eye import Eye
from semfov.io.compatibility import searching_for, trained_for
from semfov.io.files import read_text
from semfov.io.pretrained import shipped_model
from semfov.model_folder import ModelFolder
from semfov.observation.foveal import FovealObservationModel
from semfov.presets import PUBLISHED_SENSORS, published_model
from semfov.runs.config import DataConfig, DetectorConfig, SensorConfig
from semfov.sensor import Foveation, named_sensor
from semfov.threads import one_thread

_OPTIONAL = "background", "weights", "classes", "head", "stride", "input_size", "runtime", "logits", "per_class"
"""Settings of a detector that are options of `load_detector` of the same name, given only where they are changed."""


def check_sources(data: DataConfig, detector: DetectorConfig | None = None) -> None:
    """Raise an error if photographs, annotations or the detector do not exist, before any of them is loaded."""
    paths = {"data.root": data.root, "data.annotations": data.annotations}
    absent = [name for name, path in paths.items() if path is None]
    if len(absent) == 1:
        (present,) = paths.keys() - absent
        expected = "both data.root and data.annotations, or neither for the embedded scenes"
        raise InputError(f"data: expected {expected}, got {present} alone; add {absent[0]}")
    if data.root is not None and not data.root.is_dir():
        raise DataError(f"data.root: no such folder: {data.root}; check the path")
    if data.annotations is not None and not data.annotations.exists():
        raise DataError(f"data.annotations: no such file: {data.annotations}; check the path")
    if detector is not None:
        check_detector(detector.name)


def make_scenes(data: DataConfig, classes: tuple[str, ...], ids: Collection[int | str] | None = None) -> Scenes:
    """Make the scenes of the settings.

    Args:
        data: the settings: photographs if a root is given, else embedded scenes.
        classes: names of the detector's classes.
        ids: ids of the photographs to use; None for those of the settings.

    Returns:
        The scenes.

    Raises:
        DataError: a file or a folder is missing or damaged.
    """
    check_sources(data)
    if data.root is None or data.annotations is None:
        return EmbeddedScenes(classes, count=data.limit or 8, seed=data.scene_seed)
    if ids is None and data.ids is not None:
        ids = read_text(data.ids).split()  # one a line
    options: dict[str, Any] = {name: getattr(data, name) for name in ("limit", "min_instances", "max_target_area")}
    return CocoScenes(data.root, data.annotations, classes, ids=ids, **options)


def split_photographs(data: DataConfig, classes: tuple[str, ...], every: int) -> tuple[Scenes, Scenes]:
    """Split photographs into those to fit on and those that are held out; of embedded scenes make two sets.

    Args:
        data: the settings of the scenes.
        classes: names of the detector's classes.
        every: one in so many photographs is held out.

    Returns:
        The scenes to fit on, and those that are held out.

    Raises:
        InputError: there are too few photographs.
    """
    check_sources(data)
    if data.root is None:
        count = data.limit or 16
        fitted = EmbeddedScenes(classes, count=count, seed=data.scene_seed)
        held_out = EmbeddedScenes(classes, count=count, seed=data.scene_seed + 1)
        return fitted, held_out
    ids = [*make_scenes(data, classes).ids]
    check(len(ids) >= 2 * every, "data", f"at least {2 * every} photographs", len(ids))
    # One in so many, and not the last ones: files are often in the order in which they were taken.
    fitted_ids = [name for number, name in enumerate(ids) if number % every]
    return make_scenes(data, classes, fitted_ids), make_scenes(data, classes, ids[::every])


def make_detector(detector: DetectorConfig) -> Detector:
    """Load the detector of the settings."""
    # A session of onnxruntime keeps the number of threads that it is opened with.
    with one_thread():
        return load_detector(detector.name, **detector_options(detector))


def detector_options(detector: DetectorConfig) -> dict[str, Any]:
    """List the options of `semfov.load_detector` that correspond to the settings.

    Args:
        detector: the settings.

    Returns:
        The options by name: the selection of boxes, and what differs from the defaults.

    Raises:
        InputError: an option of ONNX files is given for a detector that is none.
    """
    if not detector.name.endswith(".onnx"):
        expected = f"none, since detector.name {detector.name!r} is not an ONNX file"
        for name in ("head", "colour", "logits"):
            value = getattr(detector, name)
            check(not value, f"detector.{name}", expected, repr(value))
    default = DetectorConfig()
    # A loader refuses options that it lacks, even with the value that they have by default.
    changed = [name for name in _OPTIONAL if getattr(detector, name) != getattr(default, name)]
    options = {name: getattr(detector, name) for name in ("threshold", "iou", "limit", *changed)}
    if detector.colour is not None:
        options["preprocessing"] = {"channels": detector.colour}
    return options


def make_eye(detector: DetectorConfig, sensor: SensorConfig) -> Eye:
    """Make an eye: the foveal sensor, and the detector that sees through it."""
    model = make_detector(detector)
    return Eye(sensor.make(), model, reference=sensor.reference).eval().requires_grad_(False)


def _fovea_of(eye: Eye) -> Foveation:
    """Find the fovea of an eye that needs a shipped model; raises `InputError` if it sees through another sensor."""
    sensor = eye.sensor
    if not isinstance(sensor, Foveation):
        raise InputError(
            f"sensor: expected a Foveation, since models are shipped for no other sensor, got {type(sensor).__name__}; "
            "fit models for it (semfov fit), or choose policies that need none"
        )
    return sensor


def make_observation(name: str | None, eye: Eye) -> FovealObservationModel:
    """Load an observation model by name, or the one shipped for the eye; check that it fits detector and classes."""
    model = FovealObservationModel.from_pretrained(observation_name(eye) if name is None else name)
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)


def make_searching(name: str | None, eye: Eye) -> FovealObservationModel:
    """Load an observation model that was fitted to search: by name, or the one shipped for the detector."""
    if name is None:
        _fovea_of(eye)
        name = shipped_model(FovealObservationModel, searching_for(eye.detector.name), eye.detector.name, "MODEL")
    return make_observation(name, eye)


def make_map(name: str | None, eye: Eye) -> FovealObservationModel:
    """Load an observation model for the map of all classes: by name, of a folder, or ours for the fovea's growth."""
    if name is None:
        name = _own_model(eye)
    if not Path(name).is_dir():
        return make_observation(name, eye)
    model = ModelFolder(name).map_model()
    if model is None:
        raise InputError(f"map_model: expected a folder with an observation model, got {name} without")
    model.check_compatible(eye.settings(), eye.detector.classes)
    return model.requires_grad_(False)


def observation_name(eye: Eye) -> str:
    """Name of the observation model that is shipped for an eye: the published one, or ours for the fovea's growth."""
    detector = eye.detector
    settings = eye.sensor.settings()
    for sensor in PUBLISHED_SENSORS:
        is_published = eye.reference == SensorConfig().reference and settings == named_sensor(sensor).settings()
        name = published_model(detector.name, sensor, detector.selection.threshold)
        if is_published and (FovealObservationModel.shipped / f"{name}.safetensors").is_file():
            return name
    return _own_model(eye)


def _own_model(eye: Eye) -> str:
    """Name our own observation model for a detector and the growth of a fovea."""
    detector = eye.detector.name
    name = trained_for(detector, float(_fovea_of(eye).growth))
    return shipped_model(FovealObservationModel, name, detector, "MODEL")


def make_verification(name: str | None, eye: Eye) -> Verification:
    """Load the verification of targets by name, or the one shipped for the detector; check that it fits the eye."""
    if name is None:
        _fovea_of(eye)
        name = shipped_model(Verification, eye.detector.name, eye.detector.name, "MODEL")
    model = Verification.from_pretrained(name)
    model.check_compatible(eye.settings())
    return model.requires_grad_(False)
