"""Settings of comparisons of policies: the saliency baselines, and a folder of models."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, Self

from semfov.gaze.saliency.cells import Reduction
from semfov.io.ranges import Weight
from semfov.model_folder import ModelFolder
from semfov.runs.config import RunConfig, SensorConfig
from semfov.runs.settings import Settings


@dataclass(frozen=True)
class SaliencyConfig(Settings):
    """The saliency baselines, `vocus2`, `itti-koch` and `people`.

    Args:
        view: `foveated` computes the saliency of the foveated view from each fixation (published); `picture` computes
            the saliency of the whole sharp photograph, once. Only `people` depends on the detector.
        reduction: the saliency of a cell is the `max` or the `mean` of that of its pixels.
        weight: weight of the saliency map as a prior over the cells, for policies that have one.
    """

    view: Literal["foveated", "picture"] = "foveated"
    reduction: Reduction = "max"
    weight: Weight = 1.0


@dataclass(frozen=True)
class ComparedConfig(RunConfig):
    """Policies that are compared in the episodes of a protocol.

    Args:
        saliency: the saliency baselines.
        models: folder written by `semfov fit`, which defines detector, sensor, grid and fitted models.
    """

    saliency: SaliencyConfig = field(default_factory=SaliencyConfig)
    models: Path | None = None

    def complete(self, folder: ModelFolder) -> Self:
        """Return the settings, completed by the values that this kind of run takes from a folder of models."""
        return self


def sensor_settings(record: Mapping[str, Any]) -> SensorConfig:
    """Return the settings of a sensor from what a folder of models keeps of it, `SensorConfig.record`."""
    names = {setting.name for setting in fields(SensorConfig)} - {"settings"}
    of_config = {name: value for name, value in record.items() if name in names}
    of_sensor = {name: value for name, value in record.items() if name not in names}
    return SensorConfig(**of_config, settings=of_sensor or None)
