"""A model of where people look for a detector: fitted to all pictures, and evaluated on folds of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from semfov.detection.detector import Detector
from semfov.errors import check
from semfov.fit.gaze import GazeFit, fitted_density
from semfov.fit.gaze_folds import CENTRE, ROWS, Fold, FoldStore, Scores
from semfov.fit.viewing import LONGEST, Viewed, ViewingData, features_of, look
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.runs.settings import Whole
from semfov.runs.tables import table


@dataclass(frozen=True)
class GazeModelFit(ViewingData):
    """Pictures that people viewed freely, and how a model of where they look is fitted to them and evaluated.

    Args:
        layers: names of the feature maps (none: those of the shipped model, or of backbone and head at
            strides 8 to 32 that the detector has).
        folds: number of folds for the evaluation, 2 or more (0: none).
        fit: how the model is fitted.
    """

    within: ClassVar[str] = "gaze."

    layers: tuple[str, ...] = ()
    folds: Whole = 5
    fit: GazeFit = field(default_factory=GazeFit)

    def __post_init__(self) -> None:
        """Check that a fold leaves pictures to fit to."""
        super().__post_init__()
        check(self.folds != 1, f"{self.within}folds", "0, or 2 or more", self.folds)


def _describe_viewing(model: FixationDensity, groups: Sequence[Viewed]) -> None:
    """Set first fixations, durations and pauses of a model to those of all people."""
    firsts, left, lengths = [], [], []
    logs: list[list[Tensor]] = [[] for _ in range(5)]
    for group in groups:
        height, width = group.size
        firsts += [(path[0] + 0.5) / torch.tensor([width, height]) for paths in group.paths for path in paths]
        for each in (one for people in group.people for one in people if one.durations is not None):
            lasting = torch.from_numpy(each.durations).float()
            for number, log in enumerate(lasting[:LONGEST].clamp(min=1).log()):
                logs[min(number, 4)].append(log)
            left.append(1000 * group.seconds - lasting.sum())
            lengths.append(len(lasting))
    first = torch.stack(firsts)
    model.start = torch.stack([first.mean(0), first.std(0, correction=0)]).clamp(0, 1)
    if left:
        times = [torch.stack(each) for each in logs if each]
        model.duration = torch.stack([torch.stack([each.mean(), each.std(correction=0)]) for each in times])
        pauses = torch.stack([time / number for time, number in zip(left, lengths, strict=True)])
        model.pause = pauses.mean().clamp(min=0)


def fit_gaze_model(config: GazeModelFit, detector: Detector, store: Path) -> tuple[FixationDensity, Scores]:
    """Look at all pictures, evaluate on folds, whose models and scores are kept in a folder, and fit to all."""
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    source = features_of(detector, config.layers)
    groups = look(config, source)
    pictures = sum(map(len, groups))
    fewest = min(sum(len(group) for group in groups if group.source == n) for n in range(len(config.fixations)))
    least = max(config.folds, 1)
    fewer = ", or fewer folds" * (config.folds > 0)
    expected = f"in each file {least} or more pictures in which somebody made two fixations{fewer}"
    check(fewest >= least, f"{config.within}fixations", expected, fewest)
    kept = FoldStore(store, {**source.what, "data": config.fingerprint})
    folds = [Fold(lambda: groups, number, config.folds, config.fit) for number in range(config.folds)]
    scored = kept.scores(detector.name, folds)
    model = fitted_density(config.fit, groups, [list(range(len(group))) for group in groups], "all pictures")
    _describe_viewing(model, groups)
    scanpaths = sum(len(some) for group in groups for some in group.people)
    known = {name: detector.settings()[name] for name in ("name", "digest", "input_size", "stretch")}
    training = {**config.fit.plain(), "pictures": pictures, "scanpaths": scanpaths}
    model.metadata |= {"detector": known, "data": config.fingerprint, "training": training}
    return model, scored


def summaries(scored: Scores) -> dict[str, dict[str, Mapping[str, float]]]:
    """Means over the held-out pictures, by number of the data set and row, of NSS, AUC and information gain."""
    found: dict[str, dict[str, Mapping[str, float]]] = {}
    for source in sorted({source for _, source in scored}):
        rows = found[str(source + 1)] = {}
        for row in (CENTRE, *ROWS[False], *ROWS[True]):
            if (row, source) in scored:
                metrics = scored[row, source]
                gain = float((metrics[:, 2] - scored[CENTRE, source][:, 2]).mean())
                means = {"NSS": float(metrics[:, 0].mean()), "AUC": float(metrics[:, 1].mean()), "gain": gain}
                rows[row] = {**means, "pictures": len(metrics)}
    return found


def gaze_report(scored: Scores) -> str:
    if not scored:
        return "fitted to all pictures; no folds were held out\n"
    lines = []
    for source, rows in summaries(scored).items():
        body = [[name, *(f"{row[figure]:.3f}" for figure in ("NSS", "AUC", "gain"))] for name, row in rows.items()]
        lines += [f"Data set {source}: {rows[CENTRE]['pictures']} pictures, each held out once", ""]
        lines += [*table([["", "NSS", "AUC", "gain over the centre bias, bit/fixation"], *body]), ""]
    return "\n".join(lines)
