"""Settings of `python -m eval.human search`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.runs.config import BeliefConfig, PolicyConfig, ProtocolConfig, RunConfig
from semfov.runs.settings import Count, Positive, Range, Settings


@dataclass(frozen=True)
class ScreenConfig(Settings):
    """The screen on which people saw the pictures, with each picture letterboxed on it.

    Args:
        width: width in pixels.
        height: height in pixels.
        degrees: width in degrees of visual angle (COCO-Search18: 54).
        start: `(x, y)` in pixels, the first fixation (default: the mean of people's first fixations in COCO-Search18).
    """

    width: Count = 1680
    height: Count = 1050
    degrees: Positive = 54.0
    start: tuple[Positive, Positive] = (816.0, 509.0)


@dataclass(frozen=True)
class PeopleSearchConfig(RunConfig):
    """Comparison of people, models and policies that search for the same targets in the same pictures.

    Args:
        people: scanpaths of people: a folder with one JSON file per person (format of Ruarte et al.), or a table
            (`.csv`).
        files: scanpaths of models, each a JSON file in the same format or a table; the file's name is the name of the
            model in the results.
        pictures: folders in which the pictures are looked for; policies search in the pictures that are found.
        screen: the screen.
        sensor: the foveal sensor; it sees the whole screen.
        belief: the belief, on a grid over the screen; the default of 32 × 24 cells is the grid of the models' files.
        protocol: the protocol; a search has failed after `shifts` gaze shifts, and `seed` draws the random baselines.
        policies: policies to compare (`python -m eval.search --help`).
        bandwidth: bandwidth, in screen pixels, of the clusters of fixations that make up the letters of a sequence.
        bootstrap: number of bootstrap samples of the pictures for the standard errors of TFP-AUC.
        out: folder for tables, figures and the manifest.
        cache: folder for the stored detections from every cell (None: the user's cache).
        store: keep detections on disk.
    """

    unused = ("data", "models")
    people: Path = Path("human_scanpaths")
    files: tuple[Path, ...] = ()
    pictures: tuple[Path, ...] = ()
    screen: ScreenConfig = field(default_factory=ScreenConfig)
    belief: BeliefConfig = field(default_factory=lambda: BeliefConfig(columns=32, rows=24))
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=9))
    policies: tuple[str | PolicyConfig, ...] = ("non-predictive-raw", "predictive-calibrated", "target-evidence")
    bandwidth: Positive = 100.0
    bootstrap: Annotated[int, Range(2, 10_000)] = 200
    out: Path = Path("runs/human_search")
