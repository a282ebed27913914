"""The fits of a model folder, one part after another; what an earlier run finished is read from the folder.

    part          builds on                              without it, or if it is no better
    ------------  -------------------------------------  ---------------------------------------------------
    observation   looks at cells                         without it explorations look at random places, with
                                                         raw scores; whether it is used there, its maps tell
    search        the same looks, from the observation   photographs are looked at by windows, with raw scores
                  model if that is used                  unless those are fitted; a fovea has raw scores, too
    verification  closer looks of the search model;      no closer looks
                  left out without one
    windows       its own looks at mosaics               slices in the order of raw scores

A part is fitted again if its settings, the detector, the sensor, the photographs, a part before it, any code of the
package or the version of a library changed. Looks are made again for another detector, sensor, grid or photograph, or
with another version of a library. Of code, they depend only on what looking imports (`semfov.io.code`).

A part that could not be fitted is stored and read like one that was, so that the same command does not try it again. To
try it again with nothing changed, delete `progress/NAME.json` in the model folder; there is no option for it.
"""

import json
import os
from contextlib import suppress
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

from semfov.errors import DataError, InputError
from semfov.fit.observation import ObservationFit
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.search_part import SearchFit
from semfov.fit.settings import FitDetectorConfig
from semfov.fit.verification_part import VerificationFit
from semfov.fit.windows_part import WindowsFit
from semfov.io.files import disk_is_full, sha256, write_text
from semfov.io.manifest import Manifest, Part
from semfov.runs.config import WHERE
from semfov.runs.looking import Looking
from semfov.runs.scene_run import digest_of
from semfov.runs.settings import plain
from semfov.runs.setup import detector_options

FITS: dict[str, type[PartFit]] = {
    "observation": ObservationFit,
    "search": SearchFit,
    "verification": VerificationFit,
    "windows": WindowsFit,
}
"""The fits of `semfov.io.manifest.PARTS`, in the order in which they build on each other."""

_SETTINGS = ("holdout", "fixations", "steps", "seed")
"""Settings that the manifest of a model folder records."""


class FolderFit:
    """The fits of all parts of a model folder.

    Attributes:
        inputs: the stored looks, and the parts that are finished.
        fits: the fits by the name of their part.
    """

    def __init__(self, config: FitDetectorConfig, run: Looking) -> None:
        self.inputs = PartInputs(config, run)
        self.fits = {name: fit(self.inputs) for name, fit in FITS.items()}

    def fit(self, name: str) -> PartResult:
        """Fit a part, or read it from the folder if it was fitted with the same settings, photographs and code.

        Args:
            name: name of the part; those before it are finished.

        Returns:
            The part. One that cannot be fitted has the reason, and is read from the folder the next time, too.
        """
        key = self._key(name)
        file = self.inputs.config.out / "progress" / f"{name}.json"
        result = self._read_result(file, key)
        if result is None:
            try:
                result = self.fits[name].fit()
            except (DataError, InputError) as error:
                # What stops this fit alone is no property of the part.
                if disk_is_full(error):
                    raise
                why = f"could not be fitted: {error}"
                result = PartResult(Part(None, None, False, why), f"Could not be fitted: {error}")
            write_text(file, json.dumps({"key": key, **result._asdict(), "part": asdict(result.part)}))
        self.inputs.results[name] = result
        return result

    def _key(self, name: str) -> str:
        """Digest all that a part depends on: photographs, looks and code, its settings, and the parts before it."""
        results = self.inputs.results
        before: list[object] = [fitted.part.sha256 for fitted in results.values()]
        before += [plain(asdict(fitted.part)) for fitted in results.values() if fitted.part.settings]
        settings = self.fits[name].settings
        values = plain(settings if isinstance(settings, dict) else asdict(settings))
        # Where the work is done changes nothing.
        relevant = {setting: value for setting, value in values.items() if setting not in WHERE}
        return digest_of([self.inputs.run.key, [name, relevant, self.inputs.config.judged, before]])

    def _read_result(self, file: Path, key: str) -> PartResult | None:
        """Read what an earlier run wrote of a part, also a failure; None unless it is complete and has this key."""
        out = self.inputs.config.out
        with suppress(Exception):  # a damaged record is no problem, as the part can be fitted again
            record = json.loads(file.read_text(encoding="utf-8"))
            part = Part(**record["part"])
            figures = tuple(record["figures"])
            model_is_same = part.file is None or sha256(out / part.file) == part.sha256
            if record["key"] == key and model_is_same and all((out / figure).is_file() for figure in figures):
                return PartResult(part, record["report"], figures)
        return None

    def manifest(self) -> Manifest:
        """Describe the folder: the detector and its sensor, the parts, and what they were fitted to."""
        config = self.inputs.config
        run = self.inputs.run
        return Manifest(
            classes=run.eye.detector.classes,
            detector=_describe_detector(config, run),
            sensor=config.sensor.record(),
            grid=(config.columns, config.rows),
            parts={name: fitted.part for name, fitted in self.inputs.results.items()},
            training={
                "data": run.scenes.fingerprint,
                "photographs": len(run.scenes),
                "held_out": len(self.inputs.held_out),
                "settings": {name: getattr(config, name) for name in _SETTINGS},
            },
        )


def _describe_detector(config: FitDetectorConfig, run: Looking) -> dict[str, Any]:
    """Describe the detector for the manifest: its name, digest, files and options."""
    detector = run.eye.detector
    options = plain(detector_options(config.detector))
    weights = options.pop("weights", None)
    is_file = Path(config.detector.name).is_file()
    return {
        "name": detector.name,
        "sha256": detector.digest,
        "model": None if is_file else config.detector.name,
        "model_file": path_from(config.detector.name, config.out) if is_file else None,
        "weights_file": None if weights is None else path_from(weights, config.out),
        "options": options,
    }


def path_from(file: str | PathLike[str], folder: str | PathLike[str]) -> dict[str, str]:
    """Return the path of a file, `relative` to a folder and `absolute`."""
    absolute = Path(file).resolve()
    try:
        relative = os.path.relpath(absolute, Path(folder).resolve())
    except ValueError:  # on another drive
        relative = str(absolute)
    return {"relative": Path(relative).as_posix(), "absolute": str(absolute)}
