"""Fit the verification of targets by closer looks, from searches of photographs with boxes."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.observers import Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.belief.verification import FEATURES, Verification
from semfov.errors import DataError
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.decision_report import mean, percent
from semfov.experiments.photograph_store import PhotographStore
from semfov.experiments.progress import track
from semfov.experiments.run import cache_folder
from semfov.experiments.settings import Count, Name, Positive, Range, Seed, Settings, Share, Side
from semfov.experiments.setup import make_eye, make_scenes, make_target_evidence
from semfov.experiments.summary import table
from semfov.metrics.calibration import calibration_error
from semfov.metrics.presence import area_under_roc
from semfov.training.closer_looks import Photograph, photographs, search
from semfov.training.outputs import model_path, training_of, write_outputs
from semfov.verifier import CandidatePlaces, Verifier, cell_of, surely

AFTER = (1, 3, 5, 8, 12)
"""Numbers of looks after which candidates are examined for the fit."""

LEVELS = tuple(number / 100 for number in range(50, 100))
"""Values from which the threshold `confirm` is chosen."""

_EACH = 3  # candidates examined after some looks
_LEAST = 0.03  # least probability of their cells
_RIDGE = 1e-4


@dataclass(frozen=True)
class FitVerificationConfig(Settings):
    """Fit the verification of targets.

    Args:
        data: photographs to learn from.
        detector: the detector that processes the foveated views and the closer looks.
        sensor: the foveal sensor.
        target_model: learned target evidence, by name or file (None: the one for the detector and the sensor).
        fitted: number of photographs that this evidence was fitted to (`--data.limit` of `train.fit_search` with
            `--data.min_instances 2`); those from which it learned are left out here (None: none is left out).
        name: name of the model (None: the detector's name).
        columns: columns of the grid.
        rows: rows of the grid.
        classes: maximum number of present classes to search for in each photograph.
        absent: maximum number of absent classes to search for (None: as many as present ones).
        max_target_area: classes that cover a larger share of the image are not searched for.
        looks: number of looks in a search.
        place: least probability of a cell that is worth a closer look.
        give_up: least probability of a cell that is worth a fixation.
        false_alarms: maximum share of absent targets that may be reported as found; it determines `confirm`.
        folds: number of parts of the photographs; each part is evaluated with a model that is fitted to the others.
        seed: seed of the choice of classes and of the first fixations.
        out: folder for the model and the report.
        cache: folder for the looks at the photographs, so that an interrupted fit continues (None: the user's cache).
    """

    data: DataConfig = field(default_factory=DataConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    target_model: str | None = None
    fitted: Count | None = None
    name: Name | None = None
    columns: Side = 10
    rows: Side = 10
    classes: Count = 2
    absent: Count | None = None
    max_target_area: Positive = 0.2
    looks: Annotated[int, Range(2, 10_000)] = 12
    place: Share = 0.2
    give_up: Share = 0.2
    false_alarms: Share = 0.01
    folds: Annotated[int, Range(2, 1000)] = 5
    seed: Seed = 0
    out: Path = Path("runs/fit_verification")
    cache: Path | None = None


@dataclass(frozen=True)
class Examined:
    """Closer looks at places that seemed to hold a target.

    Attributes:
        features: `(N, 7)`, features of the closer looks.
        right: `(N,)` boolean, whether the target is at the place.
        present: `(N,)` boolean, whether the photograph holds it.
        fold: `(N,)`, part of the photographs.
    """

    features: Tensor
    right: Tensor
    present: Tensor
    fold: Tensor


@dataclass(frozen=True)
class Verified:
    """A search in which all closer looks were made, whatever they showed.

    Attributes:
        present: whether the photograph holds the target.
        places: for each closer look, the probability that the target is there, and whether it is.
        ends: for each closer look, the number of looks of both kinds that were made up to it.
        presence: probability that the image holds the target, at the end.
        looks: number of looks of both kinds.
    """

    present: bool
    places: tuple[tuple[float, bool], ...]
    ends: tuple[int, ...]
    presence: float
    looks: int

    def found(self, confirm: float) -> tuple[bool | None, int]:
        """Decision at a threshold: whether the place is right (None: not found), and the number of looks until then."""
        for (place, right), end in zip(self.places, self.ends, strict=True):
            if place >= surely(confirm):
                return right, end
        place, right = max(self.places, default=(0.0, False))
        return (right if place >= confirm else None), self.looks


def fit_verification(config: FitVerificationConfig) -> None:
    """Search the photographs, look closely at candidates, fit, evaluate in folds, and write all results."""
    eye = make_eye(config.detector, config.sensor)
    evidence = make_target_evidence(config.target_model, eye)
    scenes = make_scenes(config.data, eye.detector.classes)
    left_out = set()
    if config.fitted is not None:
        data = replace(config.data, min_instances=2, max_target_area=None, limit=config.fitted)
        known = make_scenes(data, eye.detector.classes).ids
        holdout = evidence.metadata.get("training", {}).get("holdout", 5)
        left_out = {name for number, name in enumerate(known) if number % holdout}
    chosen = [index for index, name in enumerate(scenes.ids) if name not in left_out]
    if len(chosen) < config.folds:
        raise DataError(f"data: expected at least {config.folds} photographs for the folds, got {len(chosen)}")
    size, classes = (config.columns, config.rows), len(eye.detector.classes)
    store = PhotographStore(cache_folder(config.cache) / "searches", eye.settings(), *size, classes)
    seen = photographs(
        eye,
        scenes,
        chosen,
        size,
        classes=config.classes,
        absent=config.absent,
        max_area=config.max_target_area,
        seed=config.seed,
        store=store,
    )
    with torch.inference_mode():
        examined = examine(seen, evidence, config)
    folds = [fit(examined, examined.fold != fold) for fold in range(config.folds)]
    model = fit(examined, examined.fold >= 0)
    with torch.inference_mode():
        searches = list(verify(seen, folds, evidence, config))
    confirm = choose_confirm(searches, config.false_alarms)
    model.thresholds = Thresholds(confirm, config.give_up, config.place)
    model.metadata = {**eye.settings(), **training_of(config, scenes, "target_model")}
    path = model_path(config, eye.detector.name)
    model.save(path)
    text, figures = report(examined, folds, searches, model.thresholds, len(seen))
    write_outputs(config, text, ("judged.json", json.dumps(figures, indent=2) + "\n"), path)


def examine(seen: Sequence[Photograph], evidence: TargetEvidence, config: FitVerificationConfig) -> Examined:
    """Look closely at the candidates after some looks of every search.

    Args:
        seen: the photographs.
        evidence: the target evidence.
        config: the settings.

    Returns:
        The closer looks.

    Raises:
        DataError: there is no candidate, or none of them is right, or none wrong.
    """
    rows: list[tuple[Tensor, bool, bool, int]] = []
    observer = Target(evidence)
    for photograph in track(seen, "looking", "photograph"):
        for sought in photograph.sought:
            looks = []
            for step in search(photograph, sought, observer, config.looks):
                looks.append(step.detections)
                if len(looks) not in AFTER:
                    continue
                candidates, cells = CandidatePlaces(photograph.grid), step.belief.probability(sought.target)[0]
                for look in looks:
                    candidates.see(look)
                for _ in range(_EACH):
                    candidate = candidates.next(cells, sought.target)
                    if candidate is None or candidate.probability < _LEAST:
                        break
                    presence = float(step.belief.presence(sought.target))
                    features, box = candidates.examine(candidate, presence, photograph.close_up, sought.target)
                    right = bool(sought.goal[cell_of(box, photograph.grid)])
                    rows.append((features, right, sought.present, photograph.number % config.folds))
        photograph.close()
    if len({right for _, right, _, _ in rows}) < 2:
        raise DataError("data: expected places that hold the target and places that do not, got only one kind")
    columns = list(zip(*rows, strict=True))
    return Examined(torch.stack(columns[0]), *(torch.tensor(column) for column in columns[1:]))


def fit(examined: Examined, chosen: Tensor) -> Verification:
    r"""Fit both logistic regressions by penalised maximum likelihood.

    .. math:: \min_{w, b} \; \frac1N \sum_i \mathrm{BCE}(w^\top \phi_i + b, y_i) + \lambda |w'|^2, \qquad
              \lambda = 10^{-4}

    where w' are the weights of the features scaled to unit variance.

    Args:
        examined: the closer looks.
        chosen: `(N,)` boolean, the closer looks to fit to.

    Returns:
        The model, without thresholds.
    """
    phi = examined.features[chosen].double()
    goal = torch.stack([examined.right, examined.present], -1)[chosen].double()
    mean, scale = phi.mean(0), phi.std(0).clamp(min=1e-6)
    weight = torch.zeros(2, FEATURES, dtype=torch.float64, requires_grad=True)
    bias = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.LBFGS([weight, bias], max_iter=200, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        odds = (phi - mean) / scale @ weight.mT + bias
        value = F.binary_cross_entropy_with_logits(odds, goal, reduction="none").mean(0).sum()
        value = value + _RIDGE * weight.square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    model = Verification()
    with torch.no_grad():
        model.linear.weight.copy_(weight / scale)
        model.linear.bias.copy_(bias - (weight / scale) @ mean)
    return model.eval().requires_grad_(False)


def verify(
    seen: Sequence[Photograph], folds: Sequence[Verification], evidence: TargetEvidence, config: FitVerificationConfig
) -> Iterator[Verified]:
    """Search every photograph with the model that was not fitted to it, and make all closer looks.

    Args:
        seen: the photographs.
        folds: for each fold, the model fitted to the others.
        evidence: the target evidence.
        config: the settings.

    Yields:
        The searches.
    """
    always, observer = Thresholds(1.0, config.give_up, config.place), Target(evidence)
    for photograph in track(seen, "verifying", "photograph"):
        model = folds[photograph.number % config.folds]
        for sought in photograph.sought:
            verifier = Verifier(model, photograph.close_up, photograph.grid, sought.target, always)
            steps = list(search(photograph, sought, observer, config.looks, verifier))
            decision = verifier.conclude(steps[-1])
            places = tuple((look.place, bool(sought.goal[look.cell])) for look in verifier.looks)
            ends = tuple(look.fixation + 1 + number for number, look in enumerate(verifier.looks, 1))
            total = len(steps) + len(verifier.looks)
            yield Verified(sought.present, places, ends, decision.probability, total)
        photograph.close()


def choose_confirm(searches: Sequence[Verified], false_alarms: float) -> float:
    """Choose the least threshold at which few enough absent targets are found.

    Args:
        searches: the searches.
        false_alarms: maximum share of absent targets that may be found.

    Returns:
        The threshold, from `LEVELS`; the largest of them if none suffices.
    """
    absent = [each for each in searches if not each.present]
    for confirm in LEVELS:
        if sum(each.found(confirm)[0] is not None for each in absent) <= false_alarms * len(absent):
            return confirm
    return LEVELS[-1]


def report(
    examined: Examined, folds: Sequence[Verification], searches: Sequence[Verified], chosen: Thresholds, count: int
) -> tuple[str, dict[str, float]]:
    """Evaluate the models in folds.

    Args:
        examined: the closer looks.
        folds: for each fold, the model fitted to the others.
        searches: the searches with these models.
        chosen: the thresholds that were chosen.
        count: number of photographs.

    Returns:
        The report as Markdown, and its measures by name.
    """
    odds = torch.stack([fold(examined.features) for fold in folds])[examined.fold, torch.arange(len(examined.fold))]
    before = examined.features[:, 1]
    figures: dict[str, float] = {}
    for name, logit, there in (
        ("cell", before, examined.right),
        ("place", odds[:, 0], examined.right),
        ("image", examined.features[:, 0], examined.present),
        ("presence", odds[:, 1], examined.present),
    ):
        figures[f"{name}_nll"] = float(F.binary_cross_entropy_with_logits(logit, there.to(logit)))
        figures[f"{name}_ece"] = float(calibration_error(logit.sigmoid(), there))
        figures[f"{name}_area"] = area_under_roc(logit, there)
    there = torch.tensor([each.present for each in searches])
    figures["area"] = area_under_roc(torch.tensor([each.presence for each in searches]), there)
    chances = [["", "NLL", "ECE", "area under ROC"]]
    for told, name in (
        ("at the place, before", "cell"),
        ("at the place, after", "place"),
        ("in the image, before", "image"),
        ("in the image, after", "presence"),
    ):
        chances.append([told, *(f"{figures[f'{name}_{what}']:.3f}" for what in ("nll", "ece", "area"))])
    decisions = [["confirm", "found, there", "found, not there", "place right", "looks, there", "looks, not there"]]
    for confirm in sorted({0.5, 0.6, 0.7, 0.8, 0.9, chosen.confirm}):
        mark = " (chosen)" if confirm == chosen.confirm else ""
        decisions.append([f"{confirm:.2f}{mark}", *_row(searches, confirm)])
    return "\n".join(
        [
            f"{len(searches)} searches of {count} photographs, {int(there.sum())} of them for a present class; "
            f"{len(examined.fold)} closer looks. Each photograph is evaluated with a model fitted to other folds.",
            "",
            "Probability of the target before and after a closer look:",
            "",
            *table(chances),
            "",
            "Decisions in %, and mean numbers of looks, closer ones included. Area under the ROC of the final "
            f"probability: {figures['area']:.3f}.",
            "",
            *table(decisions),
            "",
        ]
    ), figures


def _row(searches: Sequence[Verified], confirm: float) -> list[str]:
    """Hits, false alarms, right places and looks at a threshold."""
    shares, places, looks = [], [], []
    for present in (True, False):
        ended = [each.found(confirm) for each in searches if each.present == present]
        found = [right for right, _ in ended if right is not None]
        shares.append(percent(len(found), len(ended)))
        looks.append(mean([end for _, end in ended]))
        places += found
    return [*shares, percent(sum(places), len(places)), *looks]
