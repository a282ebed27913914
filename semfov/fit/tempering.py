"""Find the exponent of the likelihoods with which the fused belief guides the gaze best."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.observers import Semantic
from semfov.data.scene import Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.errors import DataError
from semfov.fit.detector_report import Difference, section
from semfov.fit.part import FOOTPRINT, PartFit, PartInputs, PartResult
from semfov.fit.samples import Samples
from semfov.fit.settings import FitDetectorConfig
from semfov.io.manifest import Part
from semfov.runs.progress import track

EXPONENTS = (0.05, 0.1, 0.15, 0.2, 0.25, 0.35, 0.5, 0.7, 1.0)
"""Values of the exponent to compare."""

_SETTINGS = ("columns", "rows", "fixations", "max_target_area", "holdout", "seed")
"""Settings of the fit that the exponent depends on."""


def mean_hits(holdout: int, rates: dict[int, float]) -> dict[str, float]:
    """Average hit rates over the photographs to choose by (`fitted`) and over the `held_out` ones.

    Args:
        holdout: one in every n photographs is held out.
        rates: hit rates by the number of the photograph.

    Returns:
        The two means by name.

    Raises:
        DataError: one group has no photograph with a search.
    """
    groups: dict[str, list[float]] = {"fitted": [], "held_out": []}
    for index, rate in rates.items():
        groups["held_out" if index % holdout == 0 else "fitted"].append(rate)
    if not all(groups.values()):
        raise DataError(
            f"data: expected searches in photographs of both groups, got {len(groups['fitted'])} photographs to choose "
            f"by and {len(groups['held_out'])} held-out ones; give more photographs"
        )
    return {name: sum(values) / len(values) for name, values in groups.items()}


def hit_rates(
    config: FitDetectorConfig, scenes: Scenes, samples: Samples, observer: Semantic, title: str
) -> dict[int, float]:
    """Compute the share of next fixations that hit the target in each photograph.

    Args:
        config: grid and largest targets of the searches.
        scenes: the photographs.
        samples: labelled detections of their looks.
        observer: makes the belief.
        title: title of the progress bar.

    Returns:
        The shares by the number of the photograph; those without searches are left out.
    """
    rates = {}
    for index in track(range(len(scenes)), title, "scene"):
        annotation = scenes.annotation(index)
        targets = legal_targets(annotation, config.max_target_area)
        if not targets:
            continue
        detections, fixations = samples.looks_at(index)
        grid = Grid(config.columns, config.rows, annotation.size)
        covered = grid.footprint(annotation.boxes)
        goal = torch.stack([covered[annotation.labels == target].any(0) for target in targets])
        rate = hit_rate(observer, detections, fixations, grid, torch.tensor(targets), goal)
        if rate is not None:
            rates[index] = rate
    return rates


def hit_rate(
    observer: Semantic, detections: Detections, fixations: Tensor, grid: Grid, targets: Tensor, goal: Tensor
) -> float | None:
    """Compute the share of next fixations that hit the target, over targets and looks before they fixate it.

    Args:
        observer: makes the belief.
        detections: those of R looks at a photograph.
        fixations: `(R, 2)`, in pixels.
        grid: the cells.
        targets: `(T,)`, classes 1..K.
        goal: `(T, X·Y)` boolean, the cells that hold each of them.

    Returns:
        The share; None if the first look fixates all targets.
    """
    evidence = observer.weigh(detections, fixations, grid)
    belief = observer.start(len(targets), grid, detections.scores)
    visited = torch.zeros_like(goal)
    hits = []
    for look, cell in enumerate(grid.cell_of(fixations).tolist()):
        # Searches that fixate their target now are over.
        going = (~goal[:, cell]).nonzero()[:, 0]
        updated = observer.update(belief[going], evidence[torch.full_like(going, look)])
        belief.beta[going] = updated.beta
        belief.closest[going] = updated.closest
        visited[going, cell] = True
        posterior = updated.probability(targets[going]).masked_fill(visited[going], -1)
        is_best = posterior == posterior.amax(-1, keepdim=True)  # of which one is drawn
        hits.append((is_best & goal[going]).sum(-1) / is_best.sum(-1))
    shares = torch.cat(hits)
    return float(shares.mean()) if len(shares) else None


class _Fusion(NamedTuple):
    """How scores are fused: `raw` or `calibrated`, with an exponent."""

    scores: str
    exponent: float


class TemperingFit(PartFit):
    """Choose whether scores are calibrated before they are fused, and with which exponent."""

    settings: dict[str, Any]

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        self.settings = {name: getattr(self.config, name) for name in _SETTINGS}
        tried = [_title(_Fusion(scores, exponent)) for scores in ("raw", "calibrated") for exponent in EXPONENTS]
        self.tasks = dict.fromkeys(["raw", *tried], 0.005 * len(self.run.scenes))

    def fit(self) -> PartResult:
        """Choose, and compare the share of next fixations that hit the target with that of raw scores."""
        holdout = self.settings["holdout"]
        raw = self._rates(Semantic(self.inputs.components), "raw")
        rates = {fusion: self._rates(self.inputs.fusing(*fusion), _title(fusion)) for fusion in self._fusions()}
        means = {fusion: mean_hits(holdout, of_fusion) for fusion, of_fusion in rates.items()}
        best = max(means, key=lambda fusion: means[fusion]["fitted"])
        held_out = [index for index in raw if index % holdout == 0]
        fused_rates = torch.tensor([rates[best][index] for index in held_out]).numpy()
        raw_rates = torch.tensor([raw[index] for index in held_out]).numpy()
        gain = Difference.of(fused_rates, raw_rates)
        before = mean_hits(holdout, raw)["held_out"]
        why = (
            f"{100 * means[best]['held_out']:.1f} % of the next fixations hit the target with {best.scores} scores to "
            f"the power of {best.exponent:g}, {100 * before:.1f} % with raw scores; "
            f"{gain.in_words('points gained', 100)}"
        )
        settings = {"scores": best.scores, "exponent": best.exponent, "footprint": FOOTPRINT}
        part = Part(None, None, gain.better, why, settings)
        return PartResult(part, _report(best, means, before, len(held_out)))

    def _fusions(self) -> list[_Fusion]:
        """List what is tried; scores are calibrated only by an observation model that the agent uses."""
        scores = ["raw"] if self.inputs.model("observation") is None else ["raw", "calibrated"]
        return [_Fusion(kind, exponent) for kind in scores for exponent in EXPONENTS]

    def _rates(self, observer: Semantic, title: str) -> dict[int, float]:
        """Measure the hit rates of all photographs with a target."""
        return hit_rates(self.config, self.run.scenes, self.inputs.samples, observer, title)


def _title(fusion: _Fusion) -> str:
    """Return the title of the progress bar."""
    return f"{fusion.scores} {fusion.exponent:g}"


def _report(best: _Fusion, means: dict[_Fusion, dict[str, float]], before: float, held_out: int) -> str:
    """Write the report: the choice, and the hit rates on held-out photographs."""
    rows = [
        ["scores", "exponent", "next fixations that hit, %"],
        ["raw, every cell of a box", "1", f"{100 * before:.1f}"],
    ]
    for fusion, mean in means.items():
        rows.append([fusion.scores, f"{fusion.exponent:g}", f"{100 * mean['held_out']:.1f}"])
    return section(
        f"The exponent with which scores are fused ({best.scores}, {best.exponent:g}) was chosen on the training "
        f"photographs; the table shows results on {held_out} held-out photographs.",
        rows,
    )
