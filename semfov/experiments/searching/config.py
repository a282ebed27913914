"""Settings of `python -m eval.human search`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.experiments.config import (
    BeliefConfig,
    DetectorConfig,
    PolicyConfig,
    ProtocolConfig,
    SaliencyConfig,
    SensorConfig,
)
from semfov.experiments.settings import Count, Positive, Range, Settings, Workers


@dataclass(frozen=True)
class ScreenConfig(Settings):
    """The screen that people sat before, with a picture letterboxed on it.

    Args:
        width: in pixels.
        height: in pixels.
        degrees: that its width takes of the field of view (COCO-Search18: 54).
        start: `(x, y)` in pixels, where the first fixation is (of people on COCO-Search18: the mean of theirs).
    """

    width: Count = 1680
    height: Count = 1050
    degrees: Positive = 54.0
    start: tuple[Positive, Positive] = (816.0, 509.0)


@dataclass(frozen=True)
class PeopleSearchConfig(Settings):
    """People, models' files and policies that search for the same targets in the same pictures.

    Args:
        people: scanpaths of people: a folder with a JSON file for each (Ruarte et al.'s), or a table (`.csv`).
        files: scanpaths of models, each a JSON file of that kind or a table; rows are called by the files' names.
        pictures: folders with some of the pictures; policies search in those that are there.
        screen: the screen.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor; it sees the whole screen.
        belief: the grid over the screen; 32 × 24 are the cells of the models' files.
        saliency: the saliency baselines.
        protocol: `shifts` is after how many gaze shifts a search has failed, and the seed that of the floors.
        policies: policies that search (`python -m eval.search --help`).
        gaze_model: learned gaze policy, by name or file.
        bandwidth: of the clusters of fixations that sequences are spelled by, in screen pixels.
        bootstrap: samples of pictures that standard errors of TFP-AUC come from.
        out: folder for tables, figures and the manifest.
        cache: folder for what the detector saw from every cell (None: the user's cache).
        store: keep that on disk.
        workers: processes (None: one for each CPU core).
    """

    people: Path = Path("human_scanpaths")
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    screen: ScreenConfig = field(default_factory=ScreenConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=lambda: BeliefConfig(columns=32, rows=24))
    saliency: SaliencyConfig = field(default_factory=SaliencyConfig)
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=9))
    policies: tuple[str | PolicyConfig, ...] = ("non-predictive-raw", "predictive-calibrated", "target-evidence")
    gaze_model: str | None = None
    bandwidth: Positive = 100.0
    bootstrap: Annotated[int, Range(2, 10_000)] = 200
    out: Path = Path("runs/human_search")
    cache: Path | None = None
    store: bool = True
    workers: Workers | None = None
