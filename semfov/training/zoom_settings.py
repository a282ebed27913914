"""Settings of the fit of evidence by magnification."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from semfov.experiments.config import DataConfig, DetectorConfig
from semfov.experiments.settings import Count, Seed, Settings, Share, Workers
from semfov.experiments.zoom import Tile

Part = Literal["decision", "survey"]


@dataclass(frozen=True)
class FitZoomConfig(Settings):
    """Fit evidence by magnification on mosaics.

    Args:
        data: photographs to compose mosaics of; every fifth is held out.
        detector: which detector looks.
        mosaics: mosaics of 4 × 4 photographs.
        far: mosaics of 8 × 6 photographs, in which objects are half as large.
        judged: mosaics of 4 × 4 photographs that were held out, to judge the fit and to choose by.
        judged_far: mosaics of 8 × 6 photographs that were held out, to choose by.
        tile: width of a photograph's slot in pixels; three quarters of it is the height.
        searched: mosaics of 4 × 4 photographs to fit on when a search decides.
        sought: classes that are there, and as many that are not, to search for in each of them.
        passes: of such a search, at most.
        false_alarms: share of absent targets that may be called found, by which the threshold is chosen.
        surest: probability from which on a target counts as found at the latest, however many false alarms that makes.
        lost: share of the targets that may be missed because no look is worth its price any more.
        evidence: model that was fitted before, to fit anew the parts in `refit` alone (None: fit all).
        refit: parts of that model: `decision`, when a search decides, and `survey`, how many objects of any class
            closer looks find.
        steps: of the fits of what looks say of closer ones.
        survey_steps: steps of the fit of the survey.
        judging: steps of the fit of when a search decides.
        seed: of mosaics and fit.
        out: folder for the model and a report.
        cache: folder for the looks (None: the user's cache).
        workers: processes (None: one for each CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(name="yolox-nano"))
    mosaics: Count = 400
    far: Count = 40
    judged: Count = 80
    judged_far: Count = 4
    tile: Tile = 480
    searched: Count = 50
    sought: Count = 4
    passes: Count = 24
    false_alarms: Share = 0.03
    surest: Share = 0.9
    lost: Share = 0.02
    evidence: Path | None = None
    refit: tuple[Part, ...] = ("decision",)
    steps: Count = 800
    survey_steps: Count = 2000
    judging: Count = 300
    seed: Seed = 0
    out: Path = Path("runs/fit_zoom")
    cache: Path | None = None
    workers: Workers | None = None
