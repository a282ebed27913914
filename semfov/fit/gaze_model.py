"""A model of where people look for a detector: fitted anew or adapted, and evaluated on folds of the pictures."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.detection.detector import Detector
from semfov.errors import check
from semfov.fit.gaze import GazeFit, fitted_density
from semfov.fit.gaze_adapted import AdaptedFold, adapted_density
from semfov.fit.gaze_folds import CENTRE, ROWS, Fold, FoldStore, Scores
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.gaze.saliency.likeness import FEWEST, PictureLikeness, pooled
from semfov.human.viewing import LONGEST, Viewed, ViewingData, features_of, look
from semfov.io.ranges import Whole
from semfov.runs.tables import table

ANEW = "fitted anew"
ADAPTED = "the shipped model, adapted by four numbers"
_FEWEST_ADAPTED = 4  # pictures of a fold to which a model is adapted
_DURATIONS = 5  # numbers of fixations with a duration of their own; later ones have that of the last


@dataclass(frozen=True)
class GazeModelFit(ViewingData):
    """Pictures that people viewed freely, and how a model of where they look is fitted to them and evaluated.

    Args:
        layers: names of the feature maps (none: those of the shipped model, or of backbone and head at
            strides 8 to 32 that the detector has).
        folds: number of folds for the evaluation, 2 or more (0: none).
        adapt: also adapt the model that is shipped for the detector, and keep the one that predicts held-out pictures
            better; not for pictures that it was fitted to.
        fit: how the model is fitted.
    """

    within: ClassVar[str] = "gaze."

    layers: tuple[str, ...] = ()
    folds: Whole = 5
    adapt: bool = True
    fit: GazeFit = field(default_factory=GazeFit)

    def __post_init__(self) -> None:
        """Check that a fold leaves pictures to fit to."""
        super().__post_init__()
        check(self.folds != 1, f"{self.within}folds", "0, or 2 or more", self.folds)


def _describe_viewing(model: FixationDensity, groups: Sequence[Viewed]) -> None:
    """Set first fixations, durations and pauses of a model to those of all people."""
    _describe_starts(model, groups)
    logs: dict[int, list[Tensor]] = defaultdict(list)  # of durations, by the number of the fixation
    pauses = []
    for group in groups:
        for scanpath in _timed(group):
            durations = torch.from_numpy(scanpath.durations).float()
            # A duration of 0 ms has no logarithm.
            for number, log in enumerate(durations[:LONGEST].clamp(min=1).log()):
                logs[min(number, _DURATIONS - 1)].append(log)
            # The time that no fixation takes, for each of them.
            pauses.append((1000 * group.seconds - durations.sum()) / len(durations))
    if pauses:
        model.duration = torch.stack([_mean_and_spread(torch.stack(of_number)) for of_number in logs.values()])
        model.pause = torch.stack(pauses).mean().clamp(min=0)  # durations may exceed the stated time


def _describe_starts(model: FixationDensity, groups: Sequence[Viewed]) -> None:
    """Set mean and standard deviation of first fixations, in shares of width and height."""
    starts = []
    for group in groups:
        height, width = group.size
        sides = torch.tensor([width, height])
        starts += [(path[0] + 0.5) / sides for path in chain.from_iterable(group.paths)]
    model.start = _mean_and_spread(torch.stack(starts)).clamp(0, 1)


def _mean_and_spread(values: Tensor) -> Tensor:
    """Compute mean and standard deviation along the first side, `(2, ...)`."""
    # Without Bessel's correction, by which a single value has a spread of NaN.
    return torch.stack([values.mean(0), values.std(0, correction=0)])


def _timed(group: Viewed) -> Iterator[Fixations]:
    """Go through the scanpaths of a group with durations."""
    for people in group.people:
        for scanpath in people:
            if scanpath.durations is not None:
                yield scanpath


class FittedGaze(NamedTuple):
    """A model of where people look, and how well it predicts.

    Attributes:
        model: the model.
        way: how it was made, `ANEW` or `ADAPTED`.
        scores: by way, the scores of models that were made without each fold.
    """

    model: FixationDensity
    way: str
    scores: Mapping[str, Scores]


def fit_gaze_model(config: GazeModelFit, detector: Detector, folder: Path) -> FittedGaze:
    """Look at all pictures, evaluate on folds, and make a model of all in the way that predicts best.

    Args:
        config: pictures, fixations, and how the model is fitted.
        detector: gives the feature maps.
        folder: folder that keeps models and scores of folds.

    Returns:
        The model, with the scores.

    Raises:
        InputError: no file of fixations is given, or one has too few pictures for the folds.
    """
    check(len(config.fixations) > 0, "fixations", "at least one file", "none")
    source = features_of(detector, config.layers)
    groups = look(config, source)
    _check_pictures(config, groups)
    store = FoldStore(folder, {**source.what, "data": config.fingerprint})
    scores = {ANEW: store.scores(detector.name, _folds(config, groups, None))}
    shipped = _adaptable(config, detector, groups)
    if shipped is not None:
        scores[ADAPTED] = store.scores(f"{detector.name} adapted", _folds(config, groups, shipped))
    # Without folds nothing tells which way predicts better.
    way = max(scores, key=lambda way: _likelihood(scores[way])) if config.folds else ANEW

    all_pictures = [list(range(len(group))) for group in groups]
    if shipped is None or way == ANEW:
        model = fitted_density(config.fit, groups, all_pictures, "all pictures")
        model.likeness = fitted_likeness(model, groups)
    else:
        model = adapted_density(shipped, groups, all_pictures, "adapting, all pictures")
    _describe_viewing(model, groups)
    settings = detector.settings()
    model.metadata |= {
        "detector": {name: settings[name] for name in ("name", "digest", "input_size", "stretch")},
        "data": config.fingerprint,
        "training": {
            **config.fit.plain(),
            "way": way,
            "pictures": sum(map(len, groups)),
            "scanpaths": sum(len(people) for group in groups for people in group.people),
        },
    }
    return FittedGaze(model, way, scores)


def _folds(config: GazeModelFit, groups: list[Viewed], shipped: FixationDensity | None) -> list[Fold]:
    """Make the folds on which models are fitted anew, or a shipped one is adapted."""
    folds: list[Fold] = []
    for number in range(config.folds):
        if shipped is None:
            folds.append(Fold(lambda: groups, number, config.folds, config.fit))
        else:
            folds.append(AdaptedFold(lambda: groups, number, config.folds, config.fit, shipped))
    return folds


def _adaptable(config: GazeModelFit, detector: Detector, groups: Sequence[Viewed]) -> FixationDensity | None:
    """Find the shipped model of a detector that can be adapted, and compared with one that is fitted anew.

    Args:
        config: the settings of the fit.
        detector: the detector.
        groups: the pictures.

    Returns:
        The model; None where there is none for the layers, where it was fitted to some of these pictures, which it
        would predict too well, or where folds are too small.
    """
    if not config.adapt:
        return None
    shipped = FixationDensity.if_shipped(detector.name)
    channels = {name: maps.shape[1] for name, maps in groups[0].features.maps.items()}
    if shipped is None or shipped.layers != channels:
        return None
    if set(config.fingerprint) & set(shipped.metadata.get("data", [])):
        return None
    # In a fold a model is fitted to the other folds.
    pictures_of_fold = sum(map(len, groups)) * (config.folds - 1) // max(config.folds, 1)
    return shipped if pictures_of_fold >= _FEWEST_ADAPTED else None


def _likelihood(scores: Scores) -> float:
    """Average the log likelihood of fixations in held-out pictures, by map and centre bias; data sets count alike."""
    means = [values[:, 2].mean() for (row, _), values in scores.items() if row == ROWS[False][1]]
    return float(torch.stack(means).mean())


def fitted_likeness(model: FixationDensity, groups: Sequence[Viewed]) -> PictureLikeness | None:
    """Fit the distance of other pictures from those of a fit.

    Args:
        model: names the feature maps.
        groups: the pictures of the fit.

    Returns:
        The distance; None where there are too few pictures for one.
    """
    values = [pooled(group.some([picture]), model.layers) for group in groups for picture in range(len(group))]
    return PictureLikeness.fitted(torch.cat(values)) if len(values) >= FEWEST else None


def _check_pictures(config: GazeModelFit, groups: Sequence[Viewed]) -> None:
    """Check that each data set has pictures for all folds."""
    # The pictures of a data set are in a group for each of their sizes.
    counts = [0] * len(config.fixations)
    for group in groups:
        counts[group.source] += len(group)
    least = max(config.folds, 1)
    remedy = ", or fewer folds" if config.folds else ""
    expected = f"in each file {least} or more pictures in which somebody made two fixations{remedy}"
    check(min(counts) >= least, f"{config.within}fixations", expected, min(counts))


def summaries(scores: Scores) -> dict[str, dict[str, Mapping[str, float]]]:
    """Average the scores over the held-out pictures.

    Args:
        scores: scores by row and data set.

    Returns:
        By number of the data set, from 1, and row: NSS, AUC, information gain over the centre bias, and pictures.
    """
    means: dict[str, dict[str, Mapping[str, float]]] = {}
    for source in sorted({source for _, source in scores}):
        centre = scores[CENTRE, source]
        means[str(source + 1)] = {
            row: _summary(scores[row, source], centre)
            for row in (CENTRE, *ROWS[False], *ROWS[True])
            if (row, source) in scores
        }
    return means


def _summary(metrics: Tensor, centre: Tensor) -> dict[str, float]:
    """Average a row `(P, 3)`, with its gain over the centre bias `(P, 3)`."""
    return {
        "NSS": float(metrics[:, 0].mean()),
        "AUC": float(metrics[:, 1].mean()),
        "gain": float((metrics[:, 2] - centre[:, 2]).mean()),
        "pictures": len(metrics),
    }


def gaze_report(fitted: FittedGaze) -> str:
    """Report how well the ways to make a model predict held-out pictures, in Markdown."""
    if not fitted.scores[ANEW]:
        return "fitted to all pictures; no folds were held out\n"
    lines = [f"Kept: {fitted.way}.", ""] if len(fitted.scores) > 1 else []
    for way, scores in fitted.scores.items():
        for source, rows in summaries(scores).items():
            cells = [["", "NSS", "AUC", "gain over the centre bias, bit/fixation"]]
            for name, row in rows.items():
                cells.append([name, *(f"{row[figure]:.3f}" for figure in ("NSS", "AUC", "gain"))])
            pictures = f"{rows[CENTRE]['pictures']} pictures, each held out once"
            title = f"Data set {source}: {pictures}"
            lines += [title if len(fitted.scores) == 1 else f"{title}; {way}", "", *table(cells), ""]
    return "\n".join(lines)
