"""Settings of `python -m eval.human viewing`."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.runs.config import PolicyConfig, RunConfig, SaliencyConfig, SaliencyModel
from semfov.runs.settings import Count, Positive, Range, Seed, Settings, Side, Whole


@dataclass(frozen=True)
class PicturesConfig(Settings):
    """The pictures that people saw.

    Args:
        root: folder of the pictures.
        limit: use only this many pictures, the first ones.
    """

    root: Path = Path()
    limit: Count | None = None


@dataclass(frozen=True)
class DensityConfig(Settings):
    """How maps are turned into densities of the next fixation; all models have the same kinds of free parameters.

    Args:
        columns: number of columns of the raster; fixations are assigned to its bins.
        rows: number of rows of the raster.
        blurs: standard deviations, in bins, of Gaussian blurs; the best-fitting one is used.
        events: number of randomly drawn fixations on which the weights are fitted.
        seed: random seed of this draw.
    """

    columns: Side = 40
    rows: Side = 30
    blurs: tuple[Annotated[float, Range(0, 20)], ...] = (0.0, 1.0, 2.0)
    events: Count = 4000
    seed: Seed = 0


@dataclass(frozen=True)
class ViewingConfig(RunConfig):
    """Comparison of people and policies that view the same pictures without a task.

    Args:
        people: fixations of all people: the JSON file of OSIE, or a table (`.csv`) as `semfov.data.fixations` reads it.
        data: the pictures.
        belief: the belief of the policies; looks are taken from the centres of its cells.
        saliency: settings of the saliency maps that policies have as priors.
        protocol: the protocol; its seed draws the scanpaths.
        density: how maps are turned into densities.
        policies: exploration policies, by preset or settings (`python -m eval.explore --help`). The policy `landing`,
            on the cells of the raster, is always included.
        models: saliency models.
        swap: exchange the two halves of the pictures: report on the half that is otherwise used for fitting.
        sequences: models whose scanpaths are drawn and compared with those of people.
        files: scanpaths of other models in these pictures, as tables (`.csv`), to compare with those of people.
        drawings: number of pictures for which scanpaths of people and of `landing` are shown side by side.
        bandwidth: bandwidth of the clusters of fixations that make up the letters of a sequence, as a fraction of the
            picture's longer side.
        longest: number of fixations of a scanpath that are used, the first ones.
        out: folder for tables, figures and the manifest.
        cache: folder for the stored detections from every cell and for maps (None: the user's cache).
        store: keep detections and maps on disk; false computes them anew in each run.
    """

    people: Path = Path("fixations.json")
    data: PicturesConfig = field(default_factory=PicturesConfig)  # type: ignore[assignment]
    saliency: SaliencyConfig = field(default_factory=lambda: SaliencyConfig(view="picture"))
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
    models: tuple[SaliencyModel, ...] = ("vocus2", "itti-koch")  # type: ignore[assignment]
    swap: bool = False
    sequences: tuple[str, ...] = ("random", "centre bias", "nearby", "vocus2", "kl-calibrated", "landing")
    files: tuple[Path, ...] = ()
    drawings: Whole = 2
    bandwidth: Positive = 0.08
    longest: Annotated[int, Range(2, 1000)] = 20
    out: Path = Path("runs/human_viewing")
