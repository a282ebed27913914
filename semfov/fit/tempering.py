"""Find the exponent of the likelihoods with which the fused belief guides the gaze best."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.data.scene import Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.fit.detector_report import Difference, section
from semfov.fit.part import FOOTPRINT, PartFit, PartInputs, PartResult
from semfov.io.manifest import Part
from semfov.runs.progress import track
from semfov.runs.samples import Samples

_EXPONENTS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.35, 0.5, 0.7, 1.0)  # values of the exponent to compare
_SETTINGS = ("columns", "rows", "fixations", "max_target_area", "holdout", "seed")
"""Settings of the fit that the exponent depends on."""


def mean_hits(holdout: int, rates: dict[int, float]) -> dict[str, float]:
    """Average hit rates over the photographs to choose by (`fitted`) and over the `held_out` ones."""
    means: dict[str, list[float]] = {"fitted": [], "held_out": []}
    for index, share in rates.items():
        means["held_out" if index % holdout == 0 else "fitted"].append(share)
    if not all(means.values()):
        raise DataError(
            f"data: expected searches in photographs of both groups, got {len(means['fitted'])} photographs to choose "
            f"by and {len(means['held_out'])} held-out ones; give more photographs"
        )
    return {name: sum(values) / len(values) for name, values in means.items()}


def hit_rates(
    config: Any,
    scenes: Scenes,
    samples: Samples,
    observer: Semantic,
    title: str,
    *,
    least: int,
    most: int | None = None,
) -> dict[int, float]:
    """Share of next fixations that hit the target in each of `most` photographs with `least` objects."""
    rates = {}
    for index in track(range(min(most or len(scenes), len(scenes))), title, "scene"):
        annotation = scenes.annotation(index)
        targets = legal_targets(annotation, config.max_target_area)
        if len(annotation.labels) < least or not targets:
            continue
        detections, fixations = samples.looks_at(index)
        grid = Grid(config.columns, config.rows, annotation.size)
        covered = grid.footprint(annotation.boxes)
        goal = torch.stack([covered[annotation.labels == target].any(0) for target in targets])
        share = hit_rate(observer, detections, fixations, grid, torch.tensor(targets), goal)
        if share is not None:
            rates[index] = share
    return rates


def hit_rate(
    observer: Semantic, detections: Detections, fixations: Tensor, grid: Grid, targets: Tensor, goal: Tensor
) -> float | None:
    """Share of next fixations that hit the target, over targets and looks before they fixate it; goal `(T, X·Y)`."""
    evidence = observer.weigh(detections, fixations, grid)
    belief = observer.start(len(targets), grid, detections.scores)
    visited = torch.zeros_like(goal)
    hits = []
    for look, cell in enumerate(grid.cell_of(fixations).tolist()):
        going = (~goal[:, cell]).nonzero()[:, 0]
        updated = observer.update(belief[going], evidence[torch.full_like(going, look)])
        belief.beta[going], belief.closest[going] = updated.beta, updated.closest
        visited[going, cell] = True
        posterior = updated.probability(targets[going]).masked_fill(visited[going], -1)
        best = posterior == posterior.amax(-1, keepdim=True)  # of which one is drawn
        hits.append((best & goal[going]).sum(-1) / best.sum(-1))
    share = torch.cat(hits)
    return float(share.mean()) if len(share) else None


class TemperingFit(PartFit):
    """Choose whether scores are calibrated before they are fused, and with which exponent."""

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = {name: getattr(self.config, name) for name in _SETTINGS}
        tried = [f"{scores} {t:g}" for scores in ("raw", "calibrated") for t in _EXPONENTS]
        self.tasks = dict.fromkeys(["raw", *tried], 0.005 * len(self.run.scenes))

    def fit(self) -> PartResult:
        """Choose, and compare the share of next fixations that hit the target with that of raw scores."""
        inputs, holdout = self.inputs, self.settings["holdout"]
        measured = partial(hit_rates, self.config, self.run.scenes, inputs.samples, least=1)
        ways = ["raw"] if inputs.model("observation") is None else ["raw", "calibrated"]
        raw = measured(Semantic(inputs.components), "raw")
        rates = {
            (scores, exponent): measured(inputs.fusing(scores, exponent), f"{scores} {exponent:g}")
            for scores in ways
            for exponent in _EXPONENTS
        }
        means = {way: mean_hits(holdout, each) for way, each in rates.items()}
        scores, exponent = best = max(means, key=lambda way: means[way]["fitted"])
        held_out = [index for index in raw if index % holdout == 0]
        shares = (torch.tensor([each[index] for index in held_out]).numpy() for each in (rates[best], raw))
        gain = Difference.of(*shares)
        before = mean_hits(holdout, raw)["held_out"]
        why = (
            f"{100 * means[best]['held_out']:.1f} % of the next fixations hit the target with {scores} scores to the "
            f"power of {exponent:g}, {100 * before:.1f} % with raw scores; {gain.in_words('points gained', 100)}"
        )
        rows = [
            ["scores", "exponent", "next fixations that hit, %"],
            ["raw, every cell of a box", "1", f"{100 * before:.1f}"],
        ]
        rows += [[way[0], f"{way[1]:g}", f"{100 * mean['held_out']:.1f}"] for way, mean in means.items()]
        report = section(
            f"The exponent with which scores are fused ({scores}, {exponent:g}) was chosen on the training "
            f"photographs; the table shows results on {len(held_out)} held-out photographs.",
            rows,
        )
        settings = {"scores": scores, "exponent": exponent, "footprint": FOOTPRINT}
        return PartResult(Part(None, None, gain.better, why, settings), report)
