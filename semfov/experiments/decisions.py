"""Searches for what is there and for what is not, each until it decides."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor

from semfov.agent import Strategy
from semfov.belief.belief import Belief
from semfov.belief.look_features import highest_score
from semfov.belief.observers import Target
from semfov.belief.target_evidence import Thresholds
from semfov.decision import conclude, decide, decide_by_price
from semfov.episode import Step, Stopwatch, StoredLooks, rollout
from semfov.errors import check
from semfov.experiments.config import PolicyConfig, SearchConfig
from semfov.experiments.parts import Record
from semfov.experiments.run import Run
from semfov.experiments.search_protocol import choose_classes
from semfov.experiments.seeds import generator_for, noise_for
from semfov.experiments.settings import Positive, Share
from semfov.gaze.choice import Greedy, drawn_from
from semfov.gaze.policies import NonPredictive, Random, Task
from semfov.observation.matching import box_iou

Rule = Callable[[Step, int], Tensor]
"""Which searches for a class end with a step: numbers of their outcomes."""


@dataclass(frozen=True)
class DecisionConfig(SearchConfig):
    """Searches that decide; `policies` are of no account.

    Args:
        confirm: probability that the image holds the target, from which on it counts as found (None: the model's).
        give_up: probability below which a cell is not worth a look (None: the model's).
        prices: of a look, for searches that end by `decide_by_price`, beside those that end by thresholds.
    """

    policies: tuple[str | PolicyConfig, ...] = ("target-evidence",)
    confirm: Share | None = None
    give_up: Share | None = None
    prices: tuple[Positive, ...] = ()


class DecisionRun(Run):
    """Searches by learned target evidence, and by the same belief under random gaze.

    Args:
        config: of the run.
    """

    task: ClassVar[Task] = "search"
    config: DecisionConfig

    def __init__(self, config: DecisionConfig) -> None:
        context = config.belief.context
        check(context == "none", "belief.context", "none: decisions are by evidence alone", context)
        super().__init__(config)
        evidence = self.models.evidence
        assert evidence is not None
        chosen = evidence.thresholds or Thresholds(0.9, 0.05)
        self.thresholds = chosen.changed(config.confirm, config.give_up)
        # One observer, so that all weigh the looks once.
        observer = Target(evidence)
        learned, random = Strategy(observer, NonPredictive()), Strategy(observer, Random())
        by_thresholds = partial(decide, thresholds=self.thresholds)
        self.compared: dict[str, tuple[Strategy, Rule]] = {
            "target-evidence": (learned, by_thresholds),
            "random gaze": (random, by_thresholds),
            **{f"price {price:g}": (learned, partial(decide_by_price, price=price)) for price in config.prices},
        }

    def _key(self) -> str:
        evidence, config = self.models.evidence, self.config
        assert evidence is not None
        chosen = asdict(evidence.thresholds) if evidence.thresholds else None
        what = ["decisions", super()._key(), chosen, config.confirm, config.give_up, config.prices]
        return hashlib.sha256(json.dumps(what).encode()).hexdigest()

    def outcomes(self, index: int) -> tuple[list[Record], dict[str, float]]:
        """Records of all searches of a scene, and the seconds that they took."""
        protocol, annotation, grid = self.config.protocol, self.scenes.annotation(index), self.grid(index)
        watch = Stopwatch()
        area = self.config.data.max_target_area or 1.0
        classes = choose_classes(self.scenes, index, annotation, 1, area, protocol.seed)
        covered = grid.footprint(annotation.boxes)
        records: list[Record] = []
        if not classes:
            return records, watch.seconds
        detections = self.detections(index)
        with torch.inference_mode():
            image = self.scenes[index].image[None]
            sharp = self.eye.detector(image)
            tiles = [self.eye.detector(tile) for tile in quarters(image)]
        watch.lap("look")
        for target in classes:
            goal = covered[annotation.labels == target].any(0)
            start = generator_for("start", protocol.seed, self.scenes.ids[index], target)
            cell = torch.randint(len(grid), (1,), generator=start)
            noise = noise_for(protocol, len(grid), self.scenes.ids[index], target, 0)[None]
            common = {
                "scene": self.scenes.ids[index],
                "target": target,
                "present": bool(goal.any()),
                "sharp": float(highest_score(sharp, target)),
                "tiled": max(float(highest_score(seen, target)) for seen in (sharp, *tiles)),
            }
            looks = StoredLooks(detections, grid, torch.tensor([target]))
            for name, (strategy, judge) in self.compared.items():

                def rule(step: Step, judge: Rule = judge, target: int = target) -> Tensor:
                    return judge(step, target)

                with torch.inference_mode():
                    steps = search_steps(looks, strategy, target, cell, noise, rule)
                last, seen = steps[-1], torch.cat([step.cell for step in steps])
                ended = int(rule(last))
                decision = conclude(ended, last.belief, [detections[cell] for cell in seen.split(1)], grid, target)
                records.append(
                    {
                        "policy": name,
                        **common,
                        "outcome": decision.outcome,
                        "probability": decision.probability,
                        "looks": len(steps),
                        "right_place": None if decision.cell is None else bool(goal[decision.cell]),
                        "overlap": overlap(decision.box, annotation.boxes[annotation.labels == target]),
                        "landing": landing([step.belief for step in steps], seen, goal, target),
                    }
                )
        watch.lap("search")
        return records, watch.seconds


def search_steps(
    looks: StoredLooks, strategy: Strategy, target: int, start: Tensor, noise: Tensor, rule: Callable[[Step], Tensor]
) -> list[Step]:
    """Steps of one search, to its decision or through all looks.

    Args:
        looks: at the scene.
        strategy: how it is gone about.
        target: class that is searched for.
        start: `(1,)`, first cell.
        noise: `(1, N, X·Y)`, for ties, of N looks at most.
        rule: says by a number above 0 that a step decides, `(1,)`.
    """
    policy, choice = strategy.policy(target, looks.grid), Greedy(drawn_from(noise))
    ends: Callable[[Step], Tensor] = lambda step: rule(step) > 0  # noqa: E731
    return list(rollout(looks, strategy.observer, policy, start, choice, most=noise.shape[1], ends=ends))


def quarters(image: Tensor) -> list[Tensor]:
    """The four quarters of pictures `(B, C, H, W)`."""
    row, column = image.shape[-2] // 2, image.shape[-1] // 2
    rows = image[..., :row, :], image[..., row:, :]
    return [part for half in rows for part in (half[..., :column], half[..., column:])]


def overlap(box: Tensor | None, boxes: Tensor) -> float | None:
    """Largest intersection over union of a box with any of some; None without a box or with none to compare."""
    if box is None or not len(boxes):
        return None
    return float(box_iou(box[None], boxes).max())


def landing(beliefs: list[Belief], cells: Tensor, goal: Tensor, target: int) -> list[float] | None:
    """Probability of the target in the cell of the first fixation on it, before and after that look."""
    hits = goal[cells].nonzero()[:, 0].tolist()
    if not hits or hits[0] == 0:
        return None
    pair = beliefs[hits[0] - 1 : hits[0] + 1]
    return [float(belief.probability(target)[0, cells[hits[0]]]) for belief in pair]
