"""Settings for fitting evidence by magnification."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from semfov.fit.settings import FitConfig
from semfov.runs.config import DetectorConfig, WorkConfig
from semfov.runs.settings import Count, Share
from semfov.runs.window_looking import TileSize

RefitPart = Literal["decision", "survey", "verification"]


@dataclass(frozen=True)
class FitZoomConfig(FitConfig, WorkConfig):
    """Fit evidence by magnification on mosaics.

    Args:
        data: photographs to compose the mosaics from; one in five is held out.
        detector: the detector.
        mosaics: number of training mosaics of 4 × 4 photographs.
        far: number of training mosaics of 8 × 6 photographs, in which objects are half as large.
        crowded: number of training mosaics of 4 × 4 photographs of the third that hold most objects, for fitting the
            number of objects of any class.
        judged: number of mosaics of 4 × 4 held-out photographs, to evaluate the fit and to choose settings of the
            search and thresholds; and of the third of them that hold most objects.
        judged_far: number of mosaics of 8 × 6 held-out photographs, to choose settings of the search.
        tile: width in pixels of the slot of a photograph; its height is three quarters of that.
        searched: number of training mosaics of 4 × 4 photographs for fitting the decisions of searches.
        sought: number of present classes, and of absent classes, to search for in each of these mosaics.
        passes: maximum number of passes of the detector in such a search.
        false_alarms: maximum share of absent targets that may be reported as found; it determines the threshold.
        surest: upper limit of that threshold, even if more false alarms result.
        lost: maximum share of the targets that may be missed because the search gives up.
        place: least probability that the target is at a place, for a closer look there when no other look follows.
        evidence: model that was fitted before. If given, only the parts in `refit` are fitted (None: fit all).
        refit: parts of that model to fit again: `decision`, the decisions of searches, `verification`, the
            probabilities after closer looks at places that seem to hold the target, and `survey`, the number of objects
            of any class that closer looks find. The verification has to follow new decisions; without it they are made
            without closer looks.
        steps: number of training steps for predicting the results of closer looks.
        survey_steps: number of training steps for the number of objects of any class.
        judging: number of training steps for the decisions of searches.
        seed: seed of the mosaics and the fit.
        out: folder for the model and the report.
        cache: folder for the looks (None: the user's cache).
        workers: number of processes (None: one for each CPU core).
    """

    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(name="yolox-nano"))
    mosaics: Count = 400
    far: Count = 40
    crowded: Count = 240
    judged: Count = 80
    judged_far: Count = 4
    tile: TileSize = 480
    searched: Count = 50
    sought: Count = 4
    passes: Count = 24
    false_alarms: Share = 0.03
    surest: Share = 0.9
    lost: Share = 0.02
    place: Share = 0.2
    evidence: Path | None = None
    refit: tuple[RefitPart, ...] = ("decision", "verification")
    steps: Count = 800
    survey_steps: Count = 1500
    judging: Count = 300
    out: Path = Path("runs/fit_zoom")
