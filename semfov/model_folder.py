"""A folder of models: everything that was fitted to one detector, and the detector itself."""

from __future__ import annotations

import os
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers import LearnedMap, Observer, Semantic, Target
from semfov.belief.target_evidence import TargetEvidence
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.detection.torchvision import PREFIX
from semfov.detection.weights import WEIGHTS
from semfov.errors import DataError, InputError, lookup
from semfov.eye import Eye
from semfov.gaze.policies import Closer, NonPredictive, Policy, Random
from semfov.io.compatibility import NETWORKS
from semfov.io.files import inside
from semfov.io.manifest import PARTS, Manifest, find_file
from semfov.io.shipped import fit_command
from semfov.observation.foveal import FovealObservationModel
from semfov.sensor.foveation import Foveation

Model = FovealObservationModel | TargetEvidence | MapEvidence

KINDS: dict[str, type[Model]] = {
    "observation": FovealObservationModel,
    "evidence": TargetEvidence,
    "map": MapEvidence,
}
"""Parts that are models."""


def open_folder(name: str | PathLike[str]) -> ModelFolder | None:
    """The folder of models of this name; None where a detector has the name.

    Raises:
        InputError: it is neither.
        DataError: the folder has no models, or they are damaged.
    """
    path, text = Path(name), os.fspath(name)
    if path.is_dir():
        return ModelFolder(path)
    if text in WEIGHTS or path.suffix or text.startswith(PREFIX):
        return None
    raise InputError(
        f"name: expected a folder of models, or a detector that they are shipped for, got {text!r}; make a folder by "
        f"`{fit_command(out=text)}` or semfov.fit_detector"
    )


class ModelFolder:
    """What `train.fit_detector` leaves: models of one detector behind one sensor, and which of them are to be used.

    A part that did no better than raw scores on photographs that were held out is there, but is not used: `search` and
    `explore` do without it.

    Args:
        path: the folder.

    Attributes:
        manifest: what the folder says of itself.

    Raises:
        DataError: it is no such folder, or a file in it is missing, damaged or changed.
    """

    def __init__(self, path: str | PathLike[str]) -> None:
        self.path = Path(path)
        self.manifest = Manifest.read(self.path)

    def file(self, part: str) -> Path | None:
        """File of a part, whether it is used or not; None where there is none."""
        known = self.manifest.parts.get(lookup(part, PARTS, "part"))
        return None if known is None or known.file is None else inside(self.path, known.file)

    def used(self, part: str) -> bool:
        """Whether the agent goes by a part."""
        known = self.manifest.parts.get(lookup(part, PARTS, "part"))
        return known is not None and known.used

    def detector_source(
        self, detector: str | PathLike[str] | None = None, weights: str | PathLike[str] | None = None
    ) -> tuple[str, dict[str, Any]]:
        """What `semfov.load_detector` loads the detector by: a name or a path, and options.

        Args:
            detector: the network's file where it lies elsewhere now.
            weights: the file of its weights, where these are in a file of their own.

        Raises:
            DataError: the file is not where it was, seen from the folder or by its absolute path.
        """
        known = self.manifest.detector
        options = dict(known["options"])
        place = known.get("weights_file")
        if weights is not None:
            options["weights"] = os.fspath(weights)
        elif place is not None:
            options["weights"] = str(self._find(place))
        if detector is not None:
            return os.fspath(detector), options
        place = known.get("model_file")
        return (known["model"] if place is None else str(self._find(place))), options

    def load_detector(
        self,
        detector: str | PathLike[str] | None = None,
        weights: str | PathLike[str] | None = None,
        **options: Any,
    ) -> Detector:
        """The detector, with the options that it had when the models were fitted.

        Args:
            detector: see `detector_source`, as for `weights`.
            options: others of `semfov.load_detector`.

        Raises:
            DataError: it is gone, or is another network than that by its sha256.
        """
        source, own = self.detector_source(detector, weights)
        loaded = load_detector(source, **{**own, **options})
        told = self.manifest.detector["sha256"]
        if NETWORKS.get(loaded.digest, loaded.digest) != NETWORKS.get(told, told):
            raise DataError(
                f"detector: {source} is another network than {self.path} was fitted to (sha256 {loaded.digest[:12]}…, "
                f"expected {told[:12]}…); give the right file as detector=, or fit to this one: {fit_command(source)}"
            )
        return loaded

    def sensor(self) -> Foveation:
        """The sensor that the models were fitted for."""
        names = "sigma", "growth", "levels", "convention"
        return Foveation(**{name: self.manifest.sensor[name] for name in names})

    def eye(self, **source: Any) -> Eye:
        """Sensor and detector; arguments of `load_detector`."""
        eye = Eye(self.sensor(), self.load_detector(**source), reference=self.manifest.sensor["reference"])
        for model in self._models.values():
            model.check_compatible(eye.settings())
        return eye

    @cached_property
    def _models(self) -> dict[str, Model]:
        """Models that are used."""
        files = {part: self.file(part) for part in KINDS if self.used(part)}
        return {part: KINDS[part].from_pretrained(file) for part, file in files.items() if file is not None}

    def observation(self) -> FovealObservationModel:
        """The observation model, whether the agent goes by it or not.

        Raises:
            InputError: none was fitted.
        """
        file = self.file("observation")
        if file is None:
            raise InputError(
                f"name: expected a folder with an observation model, which {self.path} lacks; fit one: {fit_command()}"
            )
        return FovealObservationModel.from_pretrained(file)

    def semantic(self) -> Semantic:
        """The belief about all classes that fuses scores: tempered, and calibrated, where that was found better."""
        components = len(self.manifest.classes) + 1
        if not self.used("tempering"):
            return Semantic(components)
        settings = self.manifest.parts["tempering"].settings
        model = self._models.get("observation") if settings["scores"] == "calibrated" else None
        assert model is None or isinstance(model, FovealObservationModel)
        return Semantic(components, model, footprint=settings["footprint"], tempering=settings["exponent"])

    def search(self) -> tuple[Observer, Policy]:
        """Observer and policy of searches."""
        evidence = self._models.get("evidence")
        return (Target(evidence) if isinstance(evidence, TargetEvidence) else self.semantic()), NonPredictive()

    def explore(self) -> tuple[Observer, Policy]:
        """Observer and policy of explorations."""
        learned, sensor = self._models.get("map"), self.manifest.sensor
        if isinstance(learned, MapEvidence):
            return LearnedMap(learned), Closer(sensor["sigma"] / sensor["reference"])
        return Semantic(len(self.manifest.classes) + 1), Random()

    def parts(self, **source: Any) -> dict[str, Any]:
        """What `semfov.ActivePerception` is made of; arguments of `load_detector`."""
        grid = self.manifest.grid
        return {"eye": self.eye(**source), "search": self.search(), "explore": self.explore(), "grid": grid}

    def _find(self, place: dict[str, str]) -> Path:
        path = find_file(place, self.path)
        if path is None:
            raise DataError(
                f"detector: {place['absolute']} is gone, to which {self.path} was fitted; give its file as detector= "
                "(on a command line --detector FILE), or put it back"
            )
        return path
