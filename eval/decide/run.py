"""Searches for classes that are present and for classes that are absent, each until it reaches a decision."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import torch
from torch import Tensor

from eval.comparison.looking import ComparedLooking
from eval.comparison.model_folder import if_shipped
from eval.comparison.settings import ComparedConfig
from eval.comparison.telling import class_frequencies
from eval.decide.plain import plain_looks
from semfov.agents.episode import EpisodeLimits, Goal
from semfov.agents.window_episode import PASSES, WindowEpisode, WindowTask
from semfov.agents.windows import window_eye
from semfov.belief.belief import Belief
from semfov.belief.grid import Grid
from semfov.belief.observers import Observer, Semantic
from semfov.belief.prior import Prior
from semfov.belief.verification import Verification
from semfov.data.scene import Annotation
from semfov.decision import (
    MOST_CLOSER,
    CandidateCells,
    Decision,
    Verifier,
    cell_of,
    confirms,
    decide,
    decision_without_closer_looks,
)
from semfov.decision.candidates import LookAt
from semfov.detection.detections import Detections
from semfov.episode import Looks, Step, StoredLooks, rollout
from semfov.episode.stopwatch import Stopwatch
from semfov.eye import Eye
from semfov.gaze.acquisition.base import Task
from semfov.gaze.choice import Greedy, drawn_from
from semfov.gaze.policies import Policy
from semfov.io.ranges import Range, Share
from semfov.model_folder import ModelFolder
from semfov.observation.matching import box_iou
from semfov.observation.thresholds import Thresholds
from semfov.runs.config import PolicyConfig
from semfov.runs.looking import CellLooks
from semfov.runs.looks import photograph_looks
from semfov.runs.presets import AGENT
from semfov.runs.protocols import DrawnSearch, choose_searches
from semfov.runs.results import ResultRecord
from semfov.runs.setup import make_observation, make_verification
from semfov.runs.store import RememberedLooks
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.settings import DecisionSettings
from semfov.strategy import Strategy
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import WindowLooks

_Rule = Callable[[Step, int, Grid], Tensor]
"""Maps a step of searches, their target and their grid to the number of each search's outcome; 0: it goes on."""

WINDOWS = "windows"
"""The way of the recommended agent: a look at the whole photograph, and closer looks at windows."""

UNVERIFIED, RANDOM = f"{AGENT}, no closer looks", "random gaze"
"""Other ways to search with the agent's belief: without closer looks, and with random gaze."""

PUBLISHED, CALIBRATED = "published belief", "calibrated belief"
"""Beliefs by Kaplan's rule from calibrated scores: with an observation model of the paper's, fitted by maximum
likelihood, or with one that is trained for the posterior of the class."""

GAZE_SCORE = 0.5
"""Lowest score of a detection at the gaze that counts as a find where the belief has no thresholds."""


@dataclass(frozen=True)
class DecideConfig(ComparedConfig):
    """Search for present and for absent classes, each until a decision.

    Args:
        belief: the belief, a grid of class distributions; `search_model` is the agent's.
        protocol: the protocol; `shifts` and `seed` are used.
        confirm: the target counts as found when its probability reaches this value: at the place of a closer look, or
            in the image for a search without closer looks (None: the model's own threshold).
        stop_below: a search gives up when, in every cell not fixated yet, the probability of the target is below this
            value (None: the model's own threshold).
        place: least probability of a cell that is worth a closer look, or, without closer looks, of the fixated cell
            for a find (None: the model's own threshold).
        closer: largest number of closer looks in a search; 0 decides without them.
        windows: evidence for windows, by name or file (None: the one of `models` if its agent uses it, or the one for
            the detector, if one is shipped).
        verification: model of verification, by name or file (None: the one of `models` if its agent uses it, or the
            one that is shipped for detector and sensor, if there is one).
        rules: also measure plain rules: one unfoveated pass, with closer looks, and with quarters.
        references: also search without closer looks, with random gaze and with the published belief, for which
            photographs are looked at from every cell; without them the agent's looks suffice.
        out: folder for tables, records and the figure.
        models: folder written by `semfov fit`, which defines detector, sensor, grid, the model of searches and
            verification.
    """

    unused = ("saliency", "policies")
    policies: tuple[str | PolicyConfig, ...] = (AGENT,)
    confirm: Share | None = None
    stop_below: Share | None = None
    place: Share | None = None
    closer: Annotated[int, Range(0, 100)] = MOST_CLOSER
    windows: str | None = None
    verification: str | None = None
    rules: bool = True
    references: bool = True
    out: Path = Path("runs/decide")

    def complete(self, folder: ModelFolder) -> Self:
        """Return the settings with the folder's models that its agent uses, where none are given explicitly."""
        missing: dict[str, Any] = {}
        for name in ("windows", "verification"):
            file = folder.file(name) if folder.used(name) else None
            if file is not None and getattr(self, name) is None:
                missing[name] = str(file)
        return replace(self, **missing)


class _Way(NamedTuple):
    """A way to search with a fovea.

    Attributes:
        strategy: observer and policy.
        rule: decides when a search is over, where no closer looks do.
        verified: whether closer looks decide.
    """

    strategy: Strategy
    rule: _Rule
    verified: bool = False


@dataclass(frozen=True)
class _Scene:
    """A scene, and what all searches in it share.

    Attributes:
        index: its number.
        image: `(1, 3, H, W)`.
        grid: the grid over it.
        annotation: its objects.
        whole: detections in the whole image.
        quarters: detections in each quarter; none for a run without plain rules.
        everywhere: detections from every cell; None for a run without references.
        remembered: looks at cells and at boxes, each taken when a search first needs it.
    """

    index: int
    image: Tensor
    grid: Grid
    annotation: Annotation
    whole: Detections
    quarters: list[Detections]
    everywhere: Detections | None
    remembered: RememberedLooks[int | tuple[float, ...], Detections]

    def boxes(self, target: int) -> Tensor:
        """Select the annotated boxes of a class, `(M, 4)`."""
        return self.annotation.boxes[self.annotation.labels == target]

    def looks(self, target: int) -> Looks:
        """Make the source of looks for a search."""
        if self.everywhere is not None:
            return StoredLooks(self.everywhere, self.grid, torch.tensor([target]))
        return CellLooks(self.remembered, self.grid, self.grid.centres, target)

    def close_up(self, box: Tensor) -> Detections:
        """Look at a box closely."""
        return self.remembered(tuple(box.tolist()))


class DecisionRun(ComparedLooking):
    """Searches of the agent, with the same belief under random gaze, and with the published belief.

    The published belief (calibrated scores, Kaplan's rule, predictive search) decides in two ways: by the same
    thresholds as the others, and, without thresholds, as soon as a detection at the gaze shows the target. It is called
    calibrated where the observation model of the eye is not the paper's.

    Args:
        config: settings of the run.
    """

    task: Task = "search"
    config: DecideConfig

    def __init__(self, config: DecideConfig) -> None:
        # The key of the run, which the base makes first, depends on this model.
        self.verification: Verification | None = None
        super().__init__(config)
        # The shipped models of verification and of windows were fitted with the shipped model of searches.
        is_shipped = config.belief.search_model is None
        if config.closer and (config.verification or is_shipped):
            self.verification = if_shipped(make_verification, config.verification, self.eye)
        self.windows: GlimpseEvidence | None = None
        if config.windows is not None or is_shipped:
            self.windows = if_shipped(_window_evidence, config.windows, self.eye)
        self.by_windows = window_eye(self.eye.detector, self.windows).eval().requires_grad_(False)

        # All share one observer, so that the likelihoods of the looks are computed only once.
        observer = self.strategies[AGENT].observer
        thresholds = observer.thresholds or Thresholds(0.9, 0.05)
        self.thresholds = thresholds.changed(config.confirm, config.stop_below, config.place)
        learned = Strategy(observer, Policy("non-predictive"))
        verified = self.verification is not None
        self.compared = {AGENT: _Way(learned, self._by_thresholds, verified)}
        if config.references:
            if verified:
                self.compared[UNVERIFIED] = _Way(learned, self._by_thresholds)
            self.compared[RANDOM] = _Way(Strategy(observer, Policy("random")), self._by_thresholds, verified)
            self.compared |= self._with_published_belief()

    def _with_published_belief(self) -> dict[str, _Way]:
        """Make the ways to search with the published belief; none where the eye has no observation model."""
        model = if_shipped(make_observation, self.config.belief.model, self.eye)
        if model is None:
            return {}
        self.models = self.models._replace(observation=model)
        strategy = Strategy(Semantic(len(self.eye.detector.classes) + 1, model), Policy("predictive", model))
        name = CALIBRATED if model.metadata.get("method") == "discriminative" else PUBLISHED
        return {
            name: _Way(strategy, self._by_thresholds),
            f"{name}, a detection at the gaze": _Way(strategy, at_the_gaze),
        }

    @cached_property
    def frequencies(self) -> list[Tensor]:
        """The share of the other scenes that hold each class, by index of the scene."""
        return class_frequencies(self.scenes)

    def _by_thresholds(self, step: Step, target: int, grid: Grid) -> Tensor:
        return decide(step, target, self.thresholds)

    def _verifier(self, grid: Grid, target: int, prior: Prior) -> Verifier[Step]:
        """Make what decides one search by closer looks, with a share of the searches whose target is there."""
        assert self.verification is not None
        assert self.verification.thresholds is not None
        config = self.config
        thresholds = self.verification.thresholds.changed(config.confirm, config.stop_below, config.place)
        candidates = CandidateCells(grid, target, prior=prior)
        return Verifier(self.verification, candidates, thresholds, config.closer)

    def depends_on(self) -> dict[str, Any]:
        """List what searches depend on, the thresholds that are given, and the model of verification."""
        config = self.config
        settings = [config.confirm, config.stop_below, config.place, config.closer, config.rules, config.references]
        return {
            **super().depends_on(),
            "decisions": settings,
            "verification": self.verification,
            "windows": self.windows,
        }

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run all searches of a scene; returns their records, and the seconds that each stage took."""
        watch = Stopwatch()
        largest_area = self.config.data.max_target_area or 1.0
        searches = choose_searches(self.scenes, index, self.grid(index), self.config.protocol, 1, largest_area)
        if not searches:
            return [], watch.seconds
        scene = self._opened(index)
        watch.lap("look")
        windows = StoredWindowLooks(self.by_windows, self.scenes, index, None)
        records: list[ResultRecord] = []
        for search in searches:
            searched = self._searched(scene, search)
            if self.windows is not None:
                records.append({"policy": WINDOWS, **searched, **self._by_windows(scene, search, windows)})
            for name, outcome in self._by_cells(scene, search).items():
                records.append({"policy": name, **searched, **outcome})
        scene.remembered.save()
        watch.lap("search")
        return records, watch.seconds

    def _opened(self, index: int) -> _Scene:
        """Look at a scene as the references do: as a whole, at its quarters, and from every cell."""
        grid = self.grid(index)
        # All searches together look from most of the cells; the agent's alone look from few.
        everywhere = self.detections(index) if self.config.references else None
        image = self.scenes[index].image[None]
        with torch.inference_mode():
            whole = self.eye.detector(image)
            tiles = [self.eye.detector(tile) for tile in quarters(image)] if self.config.rules else []
        store = self.store if self.config.store and everywhere is None else None
        remembered: RememberedLooks[int | tuple[float, ...], Detections] = RememberedLooks(
            lambda: photograph_looks(self.eye, lambda: image, grid), store, lambda: self.digest(index)
        )
        return _Scene(index, image, grid, self.scenes.annotation(index), whole, tiles, everywhere, remembered)

    def _searched(self, scene: _Scene, search: DrawnSearch) -> ResultRecord:
        """Describe a search, with what the references say of it."""
        target = search.target
        plain = None
        tiled = None
        if scene.quarters:
            plain = plain_looks(self.eye, scene.image, scene.whole, target, scene.grid, search.goal)
            tiled = max(float(look.highest[0, target]) for look in (scene.whole, *scene.quarters))
        return {
            "scene": self.scenes.ids[scene.index],
            "target": target,
            "present": search.present,
            "sharp": float(scene.whole.highest[0, target]),
            "frequency": float(self.frequencies[scene.index][target]),
            "plain": plain,
            "tiled": tiled,
            "sharp_place": sharp_place(scene.whole, scene.grid, target, search.goal, scene.boxes(target)),
        }

    def _by_windows(self, scene: _Scene, search: DrawnSearch, source: WindowLooks) -> ResultRecord:
        """Search by windows, and return the outcome."""
        config = self.config
        assert self.windows is not None
        goal = Goal.of(("background", *self.eye.detector.classes), search.target)
        decisions = DecisionSettings(config.confirm, config.stop_below, None if config.closer else 0, "fit")
        path = WindowEpisode(WindowTask(goal, self.windows, decisions), source, EpisodeLimits(PASSES)).run()
        decision = path.decision
        assert decision is not None
        box = decision.box if decision.outcome == "found" else None
        return {
            "outcome": decision.outcome,
            "probability": decision.probability,
            "place": decision.place,
            "looks": path.passes,
            "closer": len(path.closer),
            "right_place": None if box is None else bool(search.goal[cell_of(box, scene.grid)]),
            "overlap": overlap(decision.box, scene.boxes(search.target)),
            "landing": None,
            "landing_seen": None,
        }

    def _by_cells(self, scene: _Scene, search: DrawnSearch) -> dict[str, ResultRecord]:
        """Search in each of the compared ways, and return the outcomes by its name."""
        looks = scene.looks(search.target)
        # Ways with one observer have one here, too, so that looks are weighed once.
        with_prior_of_fit: dict[Observer, tuple[Strategy, Prior]] = {}
        outcomes = {}
        for name, way in self.compared.items():
            observer = way.strategy.observer
            if observer not in with_prior_of_fit:
                # Targets are drawn as they were in the fit, and there as often.
                with_prior_of_fit[observer] = way.strategy.with_prior("fit", search.target)
            changed, prior = with_prior_of_fit[observer]
            way_of_search = way._replace(strategy=Strategy(changed.observer, way.strategy.policy))
            with torch.inference_mode():
                outcomes[name] = self._outcome(scene, search, looks, way_of_search, prior)
        return outcomes

    def _outcome(self, scene: _Scene, search: DrawnSearch, looks: Looks, way: _Way, prior: Prior) -> ResultRecord:
        """Search in one way, and return the outcome."""
        target = search.target

        def by_rule(step: Step) -> Tensor:
            return way.rule(step, target, scene.grid)

        verifier = self._verifier(scene.grid, target, prior) if way.verified else None
        rule: Callable[[Step], Tensor] = by_rule
        if verifier is not None:
            rule = partial(_by_closer_looks, verifier=verifier, close_up=scene.close_up)
        steps = _search_steps(looks, way.strategy, target, search.start, search.noise, rule)
        if verifier is not None:
            verifier.end()
            verifier.look_closely(scene.close_up)
            decision = verifier.final_decision()
            closer_looks = len(verifier.looks)
            place = decision.place
        else:
            decision = _decision_by_rule(way, steps, target, scene.grid)
            closer_looks = 0
            place = None
        path = torch.cat([step.cell for step in steps])
        return {
            "outcome": decision.outcome,
            "probability": decision.probability,
            "place": place,
            "looks": len(steps) + closer_looks,
            "closer": closer_looks,
            "right_place": None if decision.cell is None else bool(search.goal[decision.cell]),
            "overlap": overlap(decision.box, scene.boxes(target)),
            "landing": landing([step.belief for step in steps], path, search.goal, target),
            "landing_seen": detected_on_landing(steps, path, search.goal, target, scene.grid),
        }


def _window_evidence(name: str | None, eye: Eye) -> GlimpseEvidence:
    """Load evidence for windows by name, or the one shipped for the detector; check that it fits."""
    model = GlimpseEvidence.from_pretrained(eye.detector.name if name is None else name)
    model.check_compatible(eye.settings())
    return model.requires_grad_(False)


def at_the_gaze(step: Step, target: int, grid: Grid) -> Tensor:
    """Make the rule that ends a search when a detection at the gaze shows the target with at least the `GAZE_SCORE`."""
    return confirms(step.detections, grid, step.cell, target, GAZE_SCORE).long()


def sharp_place(detections: Detections, grid: Grid, target: int, goal: Tensor, boxes: Tensor) -> ResultRecord | None:
    """Whether the centre of the target's most confident detection lies on the target, and how well its box fits.

    Args:
        detections: detections of one look, a batch of one.
        grid: the grid over the image.
        target: the target's class, 1..K.
        goal: `(X·Y,)` boolean, the cells that the target overlaps.
        boxes: `(M, 4)`, the target's annotated boxes.

    Returns:
        A record with `right` and `overlap`; None if no detection has a score for the target.
    """
    score = detections.scores[0, :, target] * detections.mask[0]
    if not bool((score > 0).any()):
        return None
    box = detections.boxes[0, int(score.argmax())]
    return {"right": bool(goal[cell_of(box, grid)]), "overlap": overlap(box, boxes)}


def quarters(image: Tensor) -> list[Tensor]:
    """Return the four quarters of pictures `(B, C, H, W)`."""
    row = image.shape[-2] // 2
    column = image.shape[-1] // 2
    upper = image[..., :row, :]
    lower = image[..., row:, :]
    return [upper[..., :column], upper[..., column:], lower[..., :column], lower[..., column:]]


def overlap(box: Tensor | None, boxes: Tensor) -> float | None:
    """Largest intersection over union of a box with any of `boxes`; None if either is missing."""
    if box is None or not len(boxes):
        return None
    return float(box_iou(box[None], boxes).max())


def landing(beliefs: list[Belief], cells: Tensor, goal: Tensor, target: int) -> list[float] | None:
    """Probability of the target in the first fixated cell that overlaps it, before and after that look.

    Args:
        beliefs: the belief after each look.
        cells: the fixated cells in order.
        goal: `(X·Y,)` boolean, the cells that the target overlaps.
        target: the target's class, 1..K.

    Returns:
        The two probabilities; None if no look lands on the target, or if already the first one does.
    """
    number = _landing_look(cells, goal)
    if number is None:
        return None
    before_and_after = beliefs[number - 1 : number + 1]
    return [float(belief.probability(target)[0, cells[number]]) for belief in before_and_after]


def _landing_look(cells: Tensor, goal: Tensor) -> int | None:
    """Find the first look that lands on the target; None if none does, or already the look at the start."""
    hits = goal[cells].nonzero()[:, 0].tolist()
    return hits[0] if hits and hits[0] > 0 else None


def detected_on_landing(steps: list[Step], path: Tensor, goal: Tensor, target: int, grid: Grid) -> bool | None:
    """Whether the first look that lands on the target sees it.

    The look sees the target if the target is the best class of a detection over the fixated cell.

    Args:
        steps: the steps of the search.
        path: the fixated cells in order.
        goal: `(X·Y,)` boolean, the cells that the target overlaps.
        target: the target's class, 1..K.
        grid: the grid over the image.

    Returns:
        Whether it does; None if no look lands on the target, or if already the first one does (as in `landing`).
    """
    number = _landing_look(path, goal)
    if number is None:
        return None
    step = steps[number]
    seen = step.detections
    named = seen.mask & (seen.scores.argmax(-1) == target)  # more probable than background, too
    return bool(confirms(replace(seen, mask=named), grid, step.cell, target, 0.0))


LANDINGS = ["landings", "p", "seen", "p, seen", "not seen", "p, not seen"]
"""Column headings of `landing_cells`."""

LANDINGS_TEXT = (
    "Probability of the target in the first fixated cell that overlaps it (the landing), before and after that look. "
    "The target counts as seen where it is the best class of a detection over that cell."
)
"""Caption of the table of landings."""


def landing_cells(landed: Sequence[tuple[Sequence[float], bool]]) -> list[str]:
    """Write the cells under `LANDINGS` for all landings, for those that are seen, and for those that are not.

    Args:
        landed: for each landing, the probabilities before and after it, and whether the target is seen.

    Returns:
        For each group, its number of landings and its mean probabilities.
    """
    everything = [probabilities for probabilities, _ in landed]
    seen = [probabilities for probabilities, is_seen in landed if is_seen]
    not_seen = [probabilities for probabilities, is_seen in landed if not is_seen]
    cells: list[str] = []
    for group in (everything, seen, not_seen):
        means = [sum(column) / len(column) for column in zip(*group, strict=True)]
        cells += [str(len(group)), " → ".join(f"{mean:.3f}" for mean in means) or "-"]
    return cells


def _decision_by_rule(way: _Way, steps: list[Step], target: int, grid: Grid) -> Decision:
    """Make the decision of a search that has ended without closer looks."""
    last = steps[-1]
    outcome = int(way.rule(last, target, grid))
    # If a detection at the gaze has ended the search, the target's place is the fixated cell.
    cell = int(last.cell) if way.rule is at_the_gaze else None
    seen = [step.detections for step in steps]
    return decision_without_closer_looks(outcome, last.belief, seen, grid, target, cell)


def _by_closer_looks(step: Step, verifier: Verifier[Step], close_up: LookAt) -> Tensor:
    """Decide after a step `(1,)` and the closer looks that are due then: the number of the outcome, 0 to go on."""
    verifier.see(step)
    verifier.look_closely(close_up)
    return torch.full_like(step.cell, verifier.outcome())


def _search_steps(
    looks: Looks,
    strategy: Strategy,
    target: int,
    start: Tensor,
    noise: Tensor,
    rule: Callable[[Step], Tensor],
) -> list[Step]:
    """Run one search until it decides or all looks are spent.

    Args:
        looks: the looks at the picture.
        strategy: the observer, and the policy that chooses fixations.
        target: class 1..K.
        start: `(1,)`, cell of the first fixation.
        noise: `(1, N, X·Y)`, by which ties are broken; N is the largest number of looks.
        rule: decides after a step: the number of the outcome `(1,)`, 0 to go on.

    Returns:
        The steps.
    """

    def ends(step: Step) -> Tensor:
        return rule(step) > 0

    policy = strategy.policy(target, looks.grid)
    choice = Greedy(drawn_from(noise))
    return list(rollout(looks, strategy.observer, policy, start, choice, most=noise.shape[1], ends=ends))
