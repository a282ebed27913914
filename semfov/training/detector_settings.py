"""Settings of fitting everything to a detector."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from semfov.errors import InputError
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.settings import Count, Positive, Range, Seed, Settings, Side, Whole, Workers
from semfov.training.evidence import FitSearchConfig
from semfov.training.map_evidence import FitMapConfig
from semfov.training.observation_settings import FitConfig
from semfov.training.tempering import FitTemperingConfig

FEW = 8
"""Detectors of fewer classes learn from photographs without any of them, too."""
MANY = 100
"""From so many photographs on, every fifth is held out, and training takes all its steps."""


@dataclass(frozen=True)
class FitDetectorConfig(Settings):
    """Fit everything that the agent needs to a detector of your own.

    Args:
        model: the detector: a name or a file, as for `semfov.load_detector`.
        data: photographs with boxes to learn from; all of them, unless `data.limit` or `data.ids` says otherwise.
        detector: how the detector is used; its name is `model`.
        sensor: the foveal sensor.
        columns: cells in a row.
        rows: cells in a column.
        max_target_area: classes that cover a larger share of the image are not searched for.
        holdout: every n-th photograph is kept out, to judge and to choose thresholds by (None: every fifth, every third
            of fewer than 100).
        judged: most of these photographs on which searches and explorations are compared with raw ones.
        fixations: looks at each photograph that the observation model is fitted to.
        steps: steps of training for searches (None: 500, fewer for fewer than 100 photographs).
        map_steps: steps of training for maps (None: 1000, fewer for fewer than 100 photographs).
        thin: classes with fewer objects in the photographs to learn from are named in the report.
        seed: of every choice that is drawn.
        out: folder of models to write.
        cache: folder for what was seen from every cell, shared with `eval.search` (None: the user's cache).
        workers: processes that look (None: one for each CPU core).
    """

    model: Path | None = None
    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(background=None))
    sensor: SensorConfig = field(default_factory=SensorConfig)
    columns: Side = 10
    rows: Side = 10
    max_target_area: Positive = 0.2
    holdout: Annotated[int, Range(2, 10**9)] | None = None
    judged: Count = 100
    fixations: Count = 8
    steps: Count | None = None
    map_steps: Count | None = None
    thin: Whole = 20
    seed: Seed = 0
    out: Path = Path("mymodels")
    cache: Path | None = None
    workers: Workers | None = None

    def named(self) -> "FitDetectorConfig":
        """The same, with the model as the detector's name, and photographs of all sizes of targets.

        Raises:
            InputError: there is no model, or two.
        """
        default = DetectorConfig().name
        if self.model is None:
            raise InputError("model: expected the detector's name or file, got none")
        if self.detector.name not in (default, str(self.model)):
            raise InputError(f"detector.name: expected none beside the model {str(self.model)!r}")
        # Photographs without a target teach what it looks like where there is none.
        data = replace(self.data, max_target_area=None)
        return replace(self, data=data, detector=replace(self.detector, name=str(self.model)))

    def sized(self, photographs: int) -> "FitDetectorConfig":
        """The same, with what is left open as it suits so many photographs; fits are made from this."""
        few = photographs < MANY
        share = min(photographs / MANY, 1)
        return replace(
            self,
            holdout=self.holdout or (3 if few else 5),
            steps=self.steps or max(250, round(500 * share)),
            map_steps=self.map_steps or max(300, round(1000 * share)),
        )

    @property
    def _common(self) -> dict[str, object]:
        shared = {name: getattr(self, name) for name in ("data", "detector", "sensor", "seed", "out")}
        return {**shared, "holdout": self.holdout or 5}

    @property
    def observation(self) -> FitConfig:
        """Settings of the observation model."""
        return FitConfig(**self._common, fixations=self.fixations)  # type: ignore[arg-type]

    @property
    def tempering(self) -> FitTemperingConfig:
        """Settings of the exponents that are tried."""
        return FitTemperingConfig(
            **self._common,  # type: ignore[arg-type]
            fixations=self.fixations,
            columns=self.columns,
            rows=self.rows,
            min_objects=1,
            max_target_area=self.max_target_area,
        )

    def evidence(self, classes: int) -> FitSearchConfig:
        """Settings of the target evidence, for a detector of so many classes."""
        return FitSearchConfig(
            **self._common,  # type: ignore[arg-type]
            absent=2 if classes < FEW else None,
            columns=self.columns,
            rows=self.rows,
            max_target_area=self.max_target_area,
            steps=self.steps or 500,
        )

    @property
    def map(self) -> FitMapConfig:
        """Settings of the learned map."""
        return FitMapConfig(
            **self._common,  # type: ignore[arg-type]
            columns=self.columns,
            rows=self.rows,
            steps=self.map_steps or 1000,
            gain_steps=max(1, (self.map_steps or 1000) // 5),
        )
