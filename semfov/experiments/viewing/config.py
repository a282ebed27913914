"""Settings of `python -m eval.human viewing`."""

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
    SaliencyModel,
    SensorConfig,
)
from semfov.experiments.settings import Count, Positive, Range, Seed, Settings, Side, Whole, Workers


@dataclass(frozen=True)
class PicturesConfig(Settings):
    """Which pictures people saw.

    Args:
        root: their folder.
        limit: use only the first so many of them.
    """

    root: Path = Path()
    limit: Count | None = None


@dataclass(frozen=True)
class DensityConfig(Settings):
    """How maps become densities of the next fixation. Every row of the tables has the same freedom.

    Args:
        columns: bins of the raster in a row; fixations are looked up in bins.
        rows: bins in a column.
        blurs: standard deviations of Gaussian blurs in bins, of which the one that fits best is taken.
        events: fixations, drawn at random, that weights are fitted on.
        seed: that they are drawn by.
    """

    columns: Side = 40
    rows: Side = 30
    blurs: tuple[Annotated[float, Range(0, 20)], ...] = (0.0, 1.0, 2.0)
    events: Count = 4000
    seed: Seed = 0


@dataclass(frozen=True)
class ViewingConfig(Settings):
    """People and policies before the same pictures, without a task.

    Args:
        people: fixations of all people: OSIE's JSON, or a table (`.csv`) as `semfov.data.fixations` reads it.
        data: the pictures.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        belief: the grid that looks are from the cells of, and what policies believe on it.
        saliency: settings of saliency maps that policies have as priors.
        protocol: its seed is what scanpaths are drawn by.
        density: how maps become densities.
        policies: exploration policies, by preset or settings (`python -m eval.explore --help`). `landing`, on the cells
            of the raster, is always there beside them.
        models: saliency models.
        swap: report on the half of the pictures that is fitted on otherwise, and fit on the other.
        sequences: rows whose scanpaths are drawn and compared with people's.
        files: scanpaths of other models in these pictures, as tables (`.csv`), compared with people's, too.
        drawings: pictures in which scanpaths of people and of `landing` are drawn side by side.
        bandwidth: of the clusters of fixations that sequences are spelled by, in longer sides of the picture.
        longest: fixations of a scanpath that count.
        out: folder for tables, figures and the manifest.
        cache: folder for what the detector saw from every cell, and for maps (None: the user's cache).
        store: keep looks and maps on disk; false recomputes them.
        workers: processes (None: one for each CPU core).
    """

    people: Path = Path("fixations.json")
    data: PicturesConfig = field(default_factory=PicturesConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    saliency: SaliencyConfig = field(default_factory=lambda: SaliencyConfig(view="picture"))
    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    density: DensityConfig = field(default_factory=DensityConfig)
    policies: tuple[str | PolicyConfig, ...] = (
        "kl-calibrated",
        "negative-entropy-calibrated",
        "two-peaks-calibrated",
        "surprise-calibrated",
        "closer-look-learned",
        "expected-gain-learned",
        "objects-calibrated",
    )
    models: tuple[SaliencyModel, ...] = ("vocus2", "itti-koch")
    swap: bool = False
    sequences: tuple[str, ...] = ("random", "centre bias", "nearby", "vocus2", "kl-calibrated", "landing")
    files: tuple[Path, ...] = ()
    drawings: Whole = 2
    bandwidth: Positive = 0.08
    longest: Annotated[int, Range(2, 1000)] = 20
    out: Path = Path("runs/human_viewing")
    cache: Path | None = None
    store: bool = True
    workers: Workers | None = None
