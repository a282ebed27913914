"""Settings of the fit of evidence for windows: pictures to learn from, searches, and steps of training."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.fit.settings import FitConfig
from semfov.io.ranges import Count, Range, Share, Whole
from semfov.runs.config import DetectorConfig
from semfov.runs.window_looking import TileSize
from semfov.zoom.closer import USUAL_WINDOW


@dataclass(frozen=True)
class FitMosaicsConfig(FitConfig):
    """Fit evidence by magnification on mosaics.

    Args:
        holdout: one in every n photographs is held out.
        mosaics: number of training mosaics of 4 × 4 photographs.
        far: number of training mosaics of 8 × 6 photographs, in which objects are half as large, and largest number of
            those of 12 × 12 photographs of half the size, for fitting the certainty.
        crowded: number of training mosaics of 4 × 4 photographs of the third that hold most objects, for fitting the
            number of objects of any class.
        judged: number of mosaics of 4 × 4 held-out photographs, to evaluate the fit and to choose settings of the
            search and thresholds; and of the third of them that hold most objects.
        tile: width in pixels of the slot of a photograph; its height is three quarters of that.
        searched: number of training mosaics of 4 × 4 photographs for fitting the decisions of searches.
        sought: number of present classes, and of absent classes, to search for in each of these mosaics.
        passes: maximum number of passes of the detector in such a search.
        false_alarms: maximum share of absent targets that may be reported as found; it determines the threshold.
        surest: upper limit of that threshold, even if more false alarms result.
        lost: maximum share of the targets that may be missed because the search gives up.
        place: least probability that the target is at a place, for a closer look there when no other look follows.
        photographs: number of photographs that are looked at by themselves, those with most pixels first, to fit the
            evidence for photographs; 0 leaves it out.
        window: the window of a closer look in a photograph: its least side, in longer sides of the photograph, and its
            side in longer sides of the place.
        steps: number of training steps for the number of objects of a class.
        survey_steps: the same for objects of any class.
    """

    unused = ("sensor", "name")
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(name="yolox-nano"))
    holdout: Annotated[int, Range(2, 10**9)] = 5
    mosaics: Count = 400
    far: Count = 40
    crowded: Count = 240
    judged: Count = 80
    tile: TileSize = 480
    searched: Count = 50
    sought: Count = 4
    passes: Count = 24
    false_alarms: Share = 0.03
    surest: Share = 0.9
    lost: Share = 0.02
    place: Share = 0.2
    photographs: Whole = 320
    window: tuple[Share, float] = USUAL_WINDOW
    steps: Count = 800
    survey_steps: Count = 1500
    out: Path = Path("runs/fit_zoom")

    @property
    def some_explored(self) -> dict[str, int]:
        """Number of explored mosaics that have three and nine times as many photographs, for `searched` others."""
        return {"far": max(1, self.searched // 5), "small": max(1, self.searched // 10)}
