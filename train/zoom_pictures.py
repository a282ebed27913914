"""Pictures of many kinds, composed of photographs, to fit evidence by magnification on."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from semfov.data.mosaics import Mosaics
from semfov.data.scene import Scenes
from semfov.fit.windows import MosaicFit, RefitPart, crowded, measure_table
from semfov.fit.windows_evidence import ZoomExample
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.ranges import Count
from semfov.runs.tables import table
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye
from train.scattered import Scattered
from train.zoom_choice import choose_foresight, judge_survey

PictureKind = Literal["few", "many", "one class", "photographs", "objects"]
"""Mosaics of 3 × 3 photographs; of 12 × 12 of half the size; of 8 × 6 that share a class; photographs, and single
objects of few classes, scattered over one ground."""

_JUDGED = ("judged", "judged far", "judged crowded")
"""Mosaics of held-out photographs on which foresight is chosen."""

PICTURE_KINDS: tuple[PictureKind, ...] = get_args(PictureKind)


@dataclass(frozen=True)
class FitZoomConfig(FitMosaicsConfig):
    """Fit evidence by magnification on mosaics and on pictures of other kinds.

    Args:
        judged_far: number of mosaics of 8 × 6 held-out photographs, to choose settings of the search.
        kinds: kinds of pictures to fit on beside these mosaics (`PictureKind`): `few`, `many`,
            `one class`, `photographs` and `objects`.
        each: number of training pictures of each of these kinds.
        judged_each: number of pictures of held-out photographs of each of these kinds, to choose thresholds.
        evidence: model that was fitted before. If given, only the parts in `refit` are fitted (None: fit all).
        refit: parts of that model to fit again: `certainty`, the probability that an object is there, with the spread
            of expected numbers, `decision`, the decisions of searches, `survey`, the number of objects of any class
            that closer looks find, and `photograph`, the evidence for photographs. Decisions have to follow a new
            certainty, by which they are made.
    """

    judged_far: Count = 4
    kinds: tuple[PictureKind, ...] = PICTURE_KINDS
    each: Count = 20
    judged_each: Count = 6
    evidence: Path | None = None
    refit: tuple[RefitPart, ...] = ("decision", "certainty")


class PicturesFit(MosaicFit):
    """A fit on mosaics and on pictures of other kinds."""

    def __init__(self, config: FitZoomConfig, eye: WindowEye | None = None) -> None:
        super().__init__(config, eye)
        self.kinds = config.kinds
        self.mosaics |= {
            "judged far": self.mosaic(self.held_out, 8, 6, config.judged_far, 3),
            "judged crowded": self.mosaic(crowded(self.held_out, 1 / 3), 4, 4, config.judged, 6),
        }
        self.pictures |= self.mosaics
        for kind in PICTURE_KINDS:
            self.pictures[kind] = _compose_pictures(kind, self.training, config.each, config.seed, config.tile)
            self.pictures[f"judged {kind}"] = _compose_pictures(
                kind, self.held_out, config.judged_each, config.seed + 20, config.tile
            )

    def looked(self, parts: Collection[RefitPart], anew: bool) -> list[str]:
        """List also the held-out mosaics that judge a survey."""
        kinds = super().looked(parts, anew)
        return [*kinds, "judged crowded"] if "survey" in parts else kinds

    def fit_survey(self, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]]) -> list[str]:
        """Fit a survey, evaluate it, and choose the foresight of explorations; returns lines of Markdown."""
        super().fit_survey(model, examples)
        measures = judge_survey(model.survey, examples["judged"])
        measures |= judge_survey(model.survey, examples["judged crowded"], ", crowded")
        self.figures |= measures
        tried = choose_foresight(model, self, _JUDGED)
        return [
            *measure_table(measures),
            "",
            f"Foresight chosen for finding all objects: {model.survey.foresight:g}.",
            "",
            *table(tried),
            "",
        ]


def _compose_pictures(kind: PictureKind, scenes: Scenes, count: int, seed: int, tile: int = 480) -> Scenes:
    """Compose pictures of a kind; photographs are `tile` pixels wide and three quarters of that high."""
    seed += 10 + PICTURE_KINDS.index(kind)
    half_tile = tile // 2, tile * 3 // 8
    ground = 8 * tile, 9 * tile // 2
    match kind:
        case "few":
            return Mosaics(scenes, 3, 3, tile=(tile, tile * 3 // 4), count=count, seed=seed)
        case "many":
            return Mosaics(scenes, 12, 12, tile=half_tile, count=count, seed=seed)
        case "one class":
            return Mosaics(scenes, 8, 6, tile=half_tile, alike=True, count=count, seed=seed)
        case "photographs":
            sides = tile // 5, tile
            return Scattered(scenes, whole=True, size=ground, sides=sides, most=8, count=count, seed=seed)
        case "objects":
            return Scattered(scenes, size=ground, sides=(tile // 15, tile // 3), count=count, seed=seed)
