"""Fit all parts of a model folder in order. Parts that an earlier run finished are read from the folder."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from semfov.errors import DataError, InputError
from semfov.fit.detector_settings import FitDetectorConfig
from semfov.fit.evidence import EvidenceFit
from semfov.fit.map import MapFit
from semfov.fit.observation import ObservationFit
from semfov.fit.parts.base import PartFit, PartInputs, PartResult
from semfov.fit.parts.windows import WindowsFit
from semfov.fit.tempering import TemperingFit
from semfov.fit.verification import VerificationFit
from semfov.io.files import sha256, write_text
from semfov.io.manifest import Part
from semfov.runs.config import WHERE
from semfov.runs.looking import Looking
from semfov.runs.scene_run import digest_of
from semfov.runs.settings import plain

FITS: tuple[type[PartFit], ...] = (ObservationFit, TemperingFit, EvidenceFit, VerificationFit, MapFit, WindowsFit)
"""The fits of all parts, in the order of `semfov.io.manifest.PARTS`."""


class FolderFit:
    """Fit the parts to a detector."""

    def __init__(self, config: FitDetectorConfig, run: Looking) -> None:
        self.inputs = PartInputs(config, run)
        self.fits = {each.name: each(self.inputs) for each in FITS}

    @property
    def config(self) -> FitDetectorConfig:
        """The settings, with defaults that suit the number of photographs."""
        return self.inputs.config

    @property
    def results(self) -> dict[str, PartResult]:
        """The results of the finished parts by their names."""
        return self.inputs.results

    @property
    def stages(self) -> dict[str, dict[str, float]]:
        """The tasks of each part, with an estimate of their seconds on one core."""
        return {name: each.tasks for name, each in self.fits.items()}

    def fit(self, name: str) -> PartResult:
        """Fit a part, or read it from the folder if it was fitted with the same settings, photographs and code."""
        key = digest_of([self.inputs.run.key, self._settings(name)])
        result = self._read_result(name, key)
        if result is None:
            try:
                result = self.fits[name].fit()
            except (DataError, InputError) as error:
                result = PartResult(
                    Part(None, None, False, f"could not be fitted: {error}"), f"Could not be fitted: {error}"
                )
            write_text(self._record(name), json.dumps({"key": key, **asdict(result)}))
        self.results[name] = result
        return result

    def _settings(self, name: str) -> list[Any]:
        """List everything except the looks that a part and its evaluation depend on."""
        before: list[Any] = [fitted.part.sha256 for fitted in self.results.values()]
        before += [plain(asdict(each.part)) for each in self.results.values() if each.part.settings]
        settings = plain(asdict(self.fits[name].settings))
        return [name, {each: settings[each] for each in settings.keys() - {*WHERE}}, self.config.judged, before]

    def _record(self, name: str) -> Path:
        return self.config.out / "progress" / f"{name}.json"

    def _read_result(self, name: str, key: str) -> PartResult | None:
        try:
            record = json.loads(self._record(name).read_text(encoding="utf-8"))
            part = Part(**record["part"])
            whole = record["key"] == key
            whole = whole and (part.file is None or sha256(self.config.out / part.file) == part.sha256)
            whole = whole and all((self.config.out / figure).is_file() for figure in record["figures"])
        except Exception:  # a damaged record is no problem, as the part can be fitted again
            return None
        return PartResult(part, record["report"], record["figures"]) if whole else None
