"""Fit the tempering of likelihoods: `python -m train.fit_tempering` finds the exponent τ that guides the gaze best.

    python -m train.fit_tempering --data.root DIR --data.annotations instances.json --out runs/fit_tempering

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

Every photograph is fixated at random points; `train.fit_fom` shares these looks under the same `--cache`. For each
class that may be searched for, the looks are fused one after another with likelihoods to the power of τ. After each
look, the most probable cell is the next fixation. The folder `out` gets a report that lists for every τ how often this
fixation hits the target, on photographs to choose τ by and on held-out photographs.

Use the best exponent with `--belief.tempering τ`, or as the `tempering` of one policy.
"""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

from semfov.belief.grid import Footprint
from semfov.belief.observers import Semantic
from semfov.errors import check
from semfov.eye import Eye
from semfov.fit.samples import Samples
from semfov.fit.settings import FitOnCellsConfig
from semfov.fit.tempering import EXPONENTS, hit_rates, mean_hits
from semfov.io.ranges import Count, Positive, Range, Share, Whole
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.command import command
from semfov.runs.setup import make_observation
from semfov.runs.tables import table
from train.outputs import write_outputs
from train.samples import Sampler, collect_samples


@dataclass(frozen=True)
class FitTemperingConfig(FitOnCellsConfig):
    """Find the exponent of the likelihoods.

    Args:
        calibrated: compute likelihoods from the scores with the observation model shipped for the detector. If false,
            the raw scores are the likelihoods.
        footprint: which cells a detection updates.
        exponents: values of the exponent τ to compare.
        photographs: use only the first so many photographs (None: all).
        fixations: random fixations in each photograph.
        iou: must be the same as in `train.fit_fom` to share looks with it.
        seed: seed of the fixations.
        shard: number of photographs in a unit of work.
        min_objects: photographs with fewer objects are left out.
        max_target_area: classes that cover a larger share of the image are not searched for.
        holdout: one in every n photographs is held out for the evaluation.
        out: folder for the report.
        cache: folder for the labelled detections (None: `out`).
    """

    unused = ("name",)
    calibrated: bool = False
    footprint: Footprint = "box_centre"
    exponents: tuple[Positive, ...] = EXPONENTS
    photographs: Count | None = None
    fixations: Count = 8
    iou: Share = 0.5
    shard: Count = 32
    min_objects: Whole = 4
    max_target_area: Positive = 0.2
    holdout: Annotated[int, Range(2, 10**9)] = 4
    out: Path = Path("runs/fit_tempering")


def fit_tempering(config: FitTemperingConfig) -> None:
    """Collect looks, try every exponent, and write the report."""
    check(len(config.exponents) > 0, "exponents", "at least one value", "none")
    sampler = collect_samples(config, (config.cache or config.out) / "samples", "looking")
    samples = sampler.all()
    model = make_observation(None, cast(Eye, sampler.eye)) if config.calibrated else None
    hits = {exponent: _measure(config, sampler, samples, model, exponent) for exponent in config.exponents}
    write_outputs(config, _tempering_report(hits), ("hits.json", json.dumps(hits, indent=2) + "\n"))


def _measure(
    config: FitTemperingConfig,
    sampler: Sampler,
    samples: Samples,
    model: FovealObservationModel | None,
    exponent: float,
) -> dict[str, float]:
    """Measure one exponent: the share of next fixations that hit the target, as means over photographs."""
    components = len(sampler.eye.detector.classes) + 1
    observer = Semantic(components, model, footprint=config.footprint, tempering=exponent)
    rates = hit_rates(
        config,
        sampler.scenes,
        samples,
        observer,
        f"tempering {exponent:g}",
        least=config.min_objects,
        most=config.photographs,
    )
    return mean_hits(config.holdout, rates)


def _tempering_report(hits: dict[float, dict[str, float]]) -> str:
    """Report the hit rates of every exponent and the best exponent as Markdown."""
    best = max(hits, key=lambda exponent: hits[exponent]["fitted"])
    rows = [["tempering", "photographs to choose by", "held-out photographs"]]
    for exponent, means in hits.items():
        rows.append([f"{exponent:g}", f"{100 * means['fitted']:.2f}", f"{100 * means['held_out']:.2f}"])
    return "\n".join(
        [
            f"Best exponent on the photographs to choose by: {best:g}. The table shows the percentage of next "
            "fixations that hit the target, as a mean over all numbers of looks and over photographs.",
            "",
            *table(rows),
            "",
        ]
    )


main = command(fit_tempering, FitTemperingConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
