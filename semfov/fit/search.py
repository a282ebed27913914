"""Fit an observation model for searches: the odds of a miss through the belief, then presence and thresholds."""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import torch
from torch import Tensor

from semfov.belief.observers import SemanticSearch
from semfov.belief.observers.base import own
from semfov.belief.observers.semantic_search import SearchBelief
from semfov.data.scene import Scenes
from semfov.episode import Step, rollout
from semfov.errors import DataError, check
from semfov.fit.logistic import logistic_regression
from semfov.fit.presence import COUNTED, BeliefsOfSearches, fit_presence, judge_presence
from semfov.fit.samples import annotated_looks
from semfov.fit.settings import FitOnCellsConfig
from semfov.fit.through_belief import fit_through_belief
from semfov.fit.training import split, training_of
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_from
from semfov.io.ranges import Count, Positive, Range, Share, Whole
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.presence import FAINT_SCORE, log_odds_of_cells
from semfov.runs.config import DataConfig, ProtocolConfig
from semfov.runs.looking import CellLooks, Looking
from semfov.runs.progress import track
from semfov.runs.protocols import choose_searches, numbers_drawn
from semfov.runs.setup import make_scenes
from semfov.runs.tables import table

_RIDGE = 1e-3


@dataclass(frozen=True)
class FitSearchConfig(FitOnCellsConfig):
    """Fit an observation model for searches.

    Args:
        drawn: photographs whose classes tell how often a class is there where it is searched for (None: those of the
            fit, which may be few for that).
        model: observation model to start from, by name or file (None: the one for the detector and the sensor).
        holdout: one in every n photographs is held out for the evaluation.
        looks: number of looks in a search.
        steps: number of steps of the fit through the belief; 0 keeps the odds of a miss of `model`.
        classes: maximum number of present classes to search for in each photograph.
        absent: maximum number of absent classes to search for in each photograph.
        max_target_area: classes that cover a larger share of the image are not searched for.
        false_alarms: maximum share of absent targets that may be reported as found; it determines the threshold.
        surest: upper limit of that threshold, even if more false alarms result.
        lost: maximum share of the targets that may be missed because their cell is not certain enough, and maximum
            further share that may be missed because the search gives up.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=2, max_target_area=None))
    drawn: DataConfig | None = None
    model: str | None = None
    holdout: Annotated[int, Range(2, 10**9)] = 5
    looks: Annotated[int, Range(2, 10_000)] = 12
    steps: Whole = 150
    classes: Count = 2
    absent: Count = 4
    max_target_area: Positive = 0.2
    false_alarms: Share = 0.015
    surest: Share = 1.0
    lost: Share = 0.02
    out: Path = Path("runs/fit_search")


class FittedSearch(NamedTuple):
    """A model fitted for searches, and its evaluation.

    Attributes:
        model: the fitted model.
        judged: measures on held-out searches, a row for each number of looks (`judge_presence`).
        trained: number of searches that the evaluated presence was fitted to.
        held_out: number of searches that it was evaluated on.
    """

    model: FovealObservationModel
    judged: list[dict[str, float]]
    trained: int
    held_out: int

    @property
    def report(self) -> str:
        """The evaluation, the presence of the model and its thresholds, in Markdown."""
        presence = self.model.presence
        assert presence is not None
        thresholds = presence.thresholds
        assert thresholds is not None
        cell, score = presence.slopes.tolist()
        rows = [["looks", "gaze on target, %", "area under ROC", "ECE", "NLL"]]
        for row in self.judged:
            figures = (f"{row[name]:.3f}" for name in ("area", "ece", "nll"))
            rows.append([str(int(row["looks"])), f"{100 * row['found']:.1f}", *figures])
        return "\n".join(
            [
                f"Fitted to {self.trained} searches for present and for absent classes, and evaluated on "
                f"{self.held_out} searches of held-out photographs. The table shows how often the gaze has reached the "
                "target; how well the probability of presence tells present from absent classes; its expected "
                "calibration error (ECE), and its negative log likelihood (NLL).",
                "",
                *table(rows),
                "",
                f"Presence: logit P = {float(presence.offset):.2f} + {cell:.2f} logit of the most "
                f"probable cell + {score:.2f} ln(1 + s / {FAINT_SCORE:g}) of the highest score s.",
                "",
                "Thresholds: the target counts as found if the probability of its presence is at least "
                f"{thresholds.confirm:.3f} and that of a fixated cell at least {thresholds.place:.2f}. The search "
                f"gives up if no other cell has a probability of at least {thresholds.stop_below:.3f}.",
                "",
            ]
        )


def fit_search(
    start: FovealObservationModel, config: FitSearchConfig, run: Looking, *, hold_out: bool = False
) -> FittedSearch:
    """Fit odds of a miss, presence and thresholds to photographs, and evaluate them on held-out ones.

    Args:
        start: the observation model to start from.
        config: settings of searches, fit and thresholds.
        run: the photographs and their stored looks.
        hold_out: whether presence and thresholds, too, are fitted without the held-out photographs; otherwise they are
            fitted to all, once they are evaluated. The two numbers of cells, which nothing here judges, are of all.

    Returns:
        The model with its report. Its odds of a miss are fitted to the photographs that are not held out.

    Raises:
        DataError: the photographs have no class to search for, or too few to hold some out.
        InputError: `start` has no odds of a miss to keep.
    """
    check_start(start, config)
    model = _with_odds_of_a_miss(start, config, run).requires_grad_(False)
    searches = search_photographs(model, run, config, range(len(run.scenes)))
    held_out = split(searches.photograph, config.holdout)
    drawn = run.scenes if config.drawn is None else make_scenes(config.drawn, run.scenes.classes)
    shares = shares_drawn(drawn, config, config.absent)
    presence = fit_presence(searches[~held_out], shares, config)
    judged = judge_presence(presence, searches[held_out])
    model.presence = presence if hold_out else fit_presence(searches, shares, config)
    with torch.no_grad():
        model.presence.place.copy_(fit_places(model, run, config))
    # Of searches for as many absent classes as present ones, which have their target in half of all cases.
    model.presence.shares.copy_(shares_drawn(drawn, config, None))
    model.metadata |= {**run.eye.settings(), **training_of(config, run.scenes, "model", "drawn")}
    return FittedSearch(model, judged, int((~held_out).sum()), int(held_out.sum()))


def check_start(start: FovealObservationModel, config: FitSearchConfig) -> None:
    """Raise `InputError` unless a fit that keeps the odds of a miss of its model has some."""
    expected = "a model with odds of a miss where steps is 0, such as yolox-nano-search"
    check(config.steps > 0 or start.log_miss is not None, "model", expected, "one without")


def _with_odds_of_a_miss(
    start: FovealObservationModel, config: FitSearchConfig, run: Looking
) -> FovealObservationModel:
    """Fit the odds of a miss of a copy to the photographs that are not held out, or keep those of the model."""
    if config.steps == 0:
        return deepcopy(start)
    read = track(range(len(run.scenes)), "reading looks", "photograph")
    looks = ((index, run.detections(index), run.grid(index).centres) for index in read)
    annotated = annotated_looks(run.scenes, looks, run.cells, config.max_target_area)
    training = [searched for searched in annotated if len(searched.targets) and searched.photograph % config.holdout]
    record = {"looks": config.looks, "steps": config.steps, "photographs": len(training)}
    return fit_through_belief(start, training, looks=config.looks, steps=config.steps, seed=config.seed, search=record)


def shares_drawn(scenes: Scenes, config: FitSearchConfig, absent: int | None) -> Tensor:
    """Compute for each class the share of searches with a present target, smoothed by half a search of each kind.

    Args:
        scenes: the photographs.
        config: how classes are drawn.
        absent: largest number of absent classes in each photograph (None: as many as present ones).

    Returns:
        The shares, `(K,)`.
    """
    there, missing = numbers_drawn(scenes, config.classes, config.max_target_area, absent)
    return ((there + 0.5) / (there + missing + 1)).float()


def search_photographs(
    model: FovealObservationModel,
    run: Looking,
    config: FitSearchConfig,
    photographs: Sequence[int],
    *,
    title: str = "searching",
) -> BeliefsOfSearches:
    """Search photographs for present and for absent classes, where these are most probable.

    Args:
        model: the observation model, with its odds of a miss.
        run: the photographs and their stored looks.
        config: numbers of classes and looks, and seed.
        photographs: numbers of those that are searched.
        title: title of the progress bar.

    Returns:
        The beliefs after each look.

    Raises:
        DataError: there is nothing to search for.
    """
    found = []
    observer = SemanticSearch(_without_presence(model))
    for index in track(photographs, title, "photograph"):
        beliefs = _search_photograph(observer, run, config, index)
        if beliefs is not None:
            found.append(beliefs)
    if not found:
        raise DataError("data: expected photographs with a class to search for, got none; raise max_target_area")
    return BeliefsOfSearches.join(found)


def _without_presence(model: FovealObservationModel) -> FovealObservationModel:
    """Copy a model, so that the probabilities of cells are those of the belief alone."""
    copy = deepcopy(model)
    copy.presence = None
    return copy


class _SideBySide(NamedTuple):
    """Searches of a photograph for several classes, side by side, with all their looks.

    Attributes:
        targets: `(E,)`, the classes.
        goal: `(E, X·Y)` boolean, the cells that hold each.
        steps: the looks, each of E searches.
    """

    targets: Tensor
    goal: Tensor
    steps: list[Step]


@torch.inference_mode()
def _search_side_by_side(
    observer: SemanticSearch, run: Looking, config: FitSearchConfig, index: int
) -> _SideBySide | None:
    """Search a photograph for all its classes; None if there is no class to search for."""
    grid = run.grid(index)
    looks = min(config.looks, len(grid))
    protocol = ProtocolConfig(shifts=looks - 1, seed=config.seed)
    drawn = choose_searches(run.scenes, index, grid, protocol, config.classes, config.max_target_area, config.absent)
    if not drawn:
        return None
    targets = torch.tensor([search.target for search in drawn])
    looks_at_photograph = run.looks(index)
    rolled = rollout(
        CellLooks(looks_at_photograph, grid, grid.centres),
        observer,
        lambda episodes, _: TargetPosterior(targets[episodes]),
        torch.cat([search.start for search in drawn]),
        Greedy(drawn_from(torch.cat([search.noise for search in drawn]))),
        most=looks,
    )
    steps = list(rolled)
    looks_at_photograph.save()
    return _SideBySide(targets, torch.stack([search.goal for search in drawn]), steps)


@torch.inference_mode()
def _search_photograph(
    observer: SemanticSearch, run: Looking, config: FitSearchConfig, index: int
) -> BeliefsOfSearches | None:
    """Search a photograph for all its classes side by side; None if there is no class to search for."""
    searched = _search_side_by_side(observer, run, config, index)
    if searched is None:
        return None
    targets, goal, steps = searched
    by_name = zip(*(_facts(step, targets, goal) for step in steps), strict=True)
    facts, place, hit_chance, holds, hits, on_target = by_name
    return BeliefsOfSearches(
        torch.stack(facts, 1),
        torch.stack(place),
        torch.stack(hit_chance),
        torch.stack(holds),
        torch.stack(hits),
        torch.stack(on_target),
        there=goal.any(-1),
        photograph=torch.full((len(targets),), index),
        target=targets,
    )


@torch.inference_mode()
def fit_places(model: FovealObservationModel, run: Looking, config: FitSearchConfig) -> Tensor:
    """Fit the two numbers that make the probabilities of cells true, where all cells under a detection have its weight.

    Args:
        model: the observation model, with its odds of a miss.
        run: the photographs and their stored looks.
        config: numbers of classes and looks, and seed; up to `classes` absent classes are searched for, too.

    Returns:
        Offset and slope of the log odds, `(2,)` (`Presence.of_cells`).
    """
    observer = SemanticSearch(_without_presence(model), footprint="overlap")
    log_odds: list[Tensor] = []
    holds: list[Tensor] = []
    for index in track(range(len(run.scenes)), "looking at cells", "photograph"):
        searched = _search_side_by_side(observer, run, replace(config, absent=config.classes), index)
        if searched is None:
            continue
        targets, goal, steps = searched
        for number, step in enumerate(steps, 1):
            if number in COUNTED:
                log_odds.append(log_odds_of_cells(step.belief.probability(targets).double()).flatten())
                holds.append(goal.flatten())
    if not log_odds:
        return torch.tensor([0.0, 1.0])  # which leave log odds as they are
    return torch.tensor(logistic_regression(torch.cat(log_odds)[:, None], torch.cat(holds), ridge=_RIDGE))


def _facts(step: Step, targets: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
    """Read what E beliefs say after a look, as the first fields of `BeliefsOfSearches`, `(2, E)` and `(E,)` each."""
    belief = own(step.belief, SearchBelief, "belief")
    visited = step.visited
    cells = belief.probability(targets)
    place = cells.masked_fill(~visited, 0).amax(-1)
    hit_chance, best = belief.chance(targets).masked_fill(visited, 0).max(-1)
    holds = goal.gather(-1, cells.argmax(-1, keepdim=True))[:, 0]
    hits = goal.gather(-1, best[:, None])[:, 0] & ~visited.all(-1)
    return belief.facts(targets).mT, place, hit_chance, holds, hits, (visited & goal).any(-1)
