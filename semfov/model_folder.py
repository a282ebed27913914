"""A folder of models: everything that was fitted to one detector, with a reference to the detector."""

import os
from collections.abc import Mapping
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.belief.observers import Observer, Semantic, SemanticMap, SemanticSearch
from semfov.belief.verification import Verification
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.detection.weights import WEIGHTS
from semfov.errors import DataError, InputError, check, lookup
from semfov.eye import Eye
from semfov.gaze.policies import Policy
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.io.compatibility import NETWORKS
from semfov.io.files import inside
from semfov.io.manifest import PARTS, Manifest, Part
from semfov.io.pretrained import fit_command
from semfov.io.storage import kind_of_file
from semfov.observation.foveal import FovealObservationModel
from semfov.sensor.named import SENSORS
from semfov.zoom.evidence import GlimpseEvidence

_FolderModel = FovealObservationModel | Verification | GlimpseEvidence

KINDS: dict[str, type[_FolderModel]] = {
    "observation": FovealObservationModel,
    "search": FovealObservationModel,
    "verification": Verification,
    "windows": GlimpseEvidence,
}
"""Classes of the parts that are models."""
_NONE = Part(file=None, sha256=None, used=False, why="not fitted")


def is_model_file(name: str | PathLike[str]) -> bool:
    """Tell by its name whether it is the file of one model, and neither a folder of models nor a detector.

    Args:
        name: a folder, a file, or the name of a detector.
    """
    return Path(name).suffix == ".safetensors" and not Path(name).is_dir()


def open_model(path: str | PathLike[str]) -> _FolderModel:
    """Load a model that stands alone, as the commands that fit one write it.

    Args:
        path: the file.

    Returns:
        The model, of one of the kinds that folders of models hold.

    Raises:
        InputError: it is a model of another kind.
        DataError: the file is missing or damaged.
    """
    by_kind = {model.kind: model for model in KINDS.values()}
    kind = kind_of_file(path)
    if kind == FixationDensity.kind:
        remedy = "it says where people look, and `semfov gaze --model FILE` takes it"
        raise InputError(f"models: expected a model of searches or explorations, got {os.fspath(path)}; {remedy}")
    expected = " or ".join(model.title for model in by_kind.values())
    check(kind in by_kind, "models", f"a file of {expected}", f"{os.fspath(path)} with {kind or 'something else'}")
    return by_kind[kind].from_pretrained(path)


def open_folder(name: str | PathLike[str]) -> "ModelFolder | None":
    """Open a folder of models.

    Args:
        name: the folder, or the name or file of a detector.

    Returns:
        The folder; None for a detector.

    Raises:
        InputError: it is neither.
        DataError: the folder has no manifest, or a damaged one.
    """
    path = Path(name)
    text = os.fspath(name)
    if path.is_dir():
        return ModelFolder(path)
    if text in WEIGHTS or path.suffix or text.startswith("torchvision:"):
        return None
    raise InputError(
        f"name: expected a folder of models, or a detector that they are shipped for, got {text!r}; make a folder by "
        f"`{fit_command(out=text)}` or semfov.fit_detector"
    )


def _find_file(place: Mapping[str, str], folder: Path) -> Path:
    """Find the file of a detector at its place, relative to the folder of models or as it was."""
    for path in (folder / place["relative"], Path(place["absolute"])):
        if path.is_file():
            return path
    raise DataError(
        f"detector: expected {place['absolute']}, the file that {folder} was fitted to, got none; give its new place "
        "as detector= (on a command line --detector FILE), or put it back"
    )


class ModelFolder:
    """The result of `semfov fit`: models for one detector and one sensor, and which of them the agent uses."""

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self.manifest = Manifest.read(self.path)

    def _part(self, name: str) -> Part:
        """Find what the manifest says of a part; one that it does not list is none."""
        return self.manifest.parts.get(lookup(name, PARTS, "part"), _NONE)

    def file(self, part: str) -> Path | None:
        """File of a part, whether the agent uses it or not; None if there is none."""
        file = self._part(part).file
        return None if file is None else inside(self.path, file)

    def used(self, part: str) -> bool:
        """Whether the agent uses a part."""
        return self._part(part).used

    def detector_source(
        self, detector: str | PathLike[str] | None = None, weights: str | PathLike[str] | None = None
    ) -> tuple[str, dict[str, Any]]:
        """Find what `semfov.load_detector` loads.

        Args:
            detector: new place of the detector's file; None for that of the manifest.
            weights: new place of its weights; None for that of the manifest.

        Returns:
            The name or the file of the detector, and the options of `semfov.load_detector`.

        Raises:
            DataError: a file is not where it was.
        """
        record = self.manifest.detector
        options = dict(record["options"])
        weights_place = record.get("weights_file")
        if weights is not None:
            options["weights"] = os.fspath(weights)
        elif weights_place is not None:
            options["weights"] = str(_find_file(weights_place, self.path))
        if detector is not None:
            return os.fspath(detector), options
        place = record.get("model_file")
        if place is not None:
            return str(_find_file(place, self.path)), options
        return record["model"], options

    def load_detector(
        self,
        detector: str | PathLike[str] | None = None,
        weights: str | PathLike[str] | None = None,
        **options: Any,
    ) -> Detector:
        """Load the detector, with the options of the time when the models were fitted.

        Args:
            detector: new place of the detector's file; None for that of the manifest.
            weights: new place of its weights; None for that of the manifest.
            options: options of `semfov.load_detector` that replace those of the manifest.

        Returns:
            The detector.

        Raises:
            DataError: it is another network than the models were fitted to, or a file cannot be read.
        """
        source, fitted_options = self.detector_source(detector, weights)
        loaded = load_detector(source, **{**fitted_options, **options})
        digest = self.manifest.detector["sha256"]
        # Another file may hold the same network, such as the one that was shipped before.
        if NETWORKS.get(loaded.digest, loaded.digest) != NETWORKS.get(digest, digest):
            raise DataError(
                f"detector: expected the network that {self.path} was fitted to (sha256 {digest[:12]}…), got {source} "
                f"(sha256 {loaded.digest[:12]}…); give the right file as detector=, or fit to this one: "
                f"{fit_command(source)}"
            )
        return loaded

    def eye(self, **source: Any) -> Eye:
        """Load the eye, sensor and detector, with arguments for `load_detector`; checks the models against it."""
        kind = SENSORS[lookup(self.manifest.sensor["name"], SENSORS, "sensor")].make
        eye = Eye(
            kind.from_settings(self.manifest.sensor),
            self.load_detector(**source),
            reference=self.manifest.sensor["reference"],
        )
        for model in self._models.values():
            model.check_compatible(eye.settings())
        return eye

    @cached_property
    def _models(self) -> dict[str, _FolderModel]:
        """The models that the agent uses."""
        files = {part: self.file(part) for part in KINDS if self.used(part)}
        return {part: KINDS[part].from_pretrained(file) for part, file in files.items() if file is not None}

    def observation(self) -> FovealObservationModel:
        """Load the observation model, whether the agent uses it or not."""
        file = self.file("observation")
        if file is None:
            raise InputError(
                f"name: expected a folder with an observation model, got {self.path} without; fit one: {fit_command()}"
            )
        return FovealObservationModel.from_pretrained(file)

    def map_model(self) -> FovealObservationModel | None:
        """Load the observation model of explorations, of raw scores where these were better; None without one."""
        if self.file("observation") is None:
            return None
        fitted = self.observation()
        of_map = self.manifest.parts["observation"].settings.get("map", {})
        if of_map.get("scores") != "raw":
            return fitted
        return FovealObservationModel.identity(
            fitted.classes, fitted.edges, cell=of_map["raw_cell"], metadata=fitted.metadata
        ).eval()

    def arguments(self, *, detector: str | PathLike[str] | None = None, **options: Any) -> dict[str, Any]:
        """Make the arguments of `semfov.ActivePerception`, of the models that are used.

        An agent decides without closer looks, and looks at slices of large pictures, where it has no models for more.

        Args:
            detector: new place of the detector's file; None for that of the manifest.
            options: further options of `load_detector`.

        Returns:
            The arguments by name.
        """
        eye = self.eye(detector=detector, **options)
        return {
            "eye": eye,
            "search": (self._search_observer(), Policy("non-predictive")),
            "explore": self._exploration(eye),
            "verification": self._models.get("verification") if self.used("search") else None,
            "windows": self._models.get("windows"),
            "grid": self.manifest.grid,
            # Raw scores of a fovea's looks make no probability.
            "photographs": not self.used("search"),
        }

    def _search_observer(self) -> Observer:
        """Make the observer of searches: by the model fitted for them, or raw scores where these were better."""
        searching = self._models.get("search")
        if isinstance(searching, FovealObservationModel):
            return SemanticSearch(searching)
        return Semantic(len(self.manifest.classes) + 1)

    def _exploration(self, eye: Eye) -> tuple[Observer, Policy]:
        """Make the observer and the policy of explorations: the semantic map, or random looks without a model."""
        model = self.map_model()
        if model is None:
            return Semantic(len(self.manifest.classes) + 1), Policy("random")
        sensor = self.manifest.sensor
        return SemanticMap(model), Policy("closer-look", fovea=eye.sensor.width(sensor) / sensor["reference"])
