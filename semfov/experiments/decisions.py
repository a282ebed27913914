"""Searches for what is there and for what is not, each until it decides."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import ClassVar

import torch
from torch import Tensor

from semfov.agent import Strategy
from semfov.belief.belief import Belief
from semfov.belief.look_features import highest_score
from semfov.belief.observers import Target
from semfov.belief.target_evidence import Thresholds
from semfov.decision import OUTCOMES, best_box, decide
from semfov.episode import Step, Stopwatch, StoredLooks, rollout
from semfov.errors import check
from semfov.experiments.config import SearchConfig
from semfov.experiments.parts import Record
from semfov.experiments.run import Run
from semfov.experiments.search_protocol import choose_classes
from semfov.experiments.seeds import generator_for, noise_for
from semfov.gaze.choice import Greedy, drawn_from
from semfov.gaze.policies import NonPredictive, Random, Task
from semfov.observation.matching import box_iou


class DecisionRun(Run):
    """Searches by learned target evidence, and by the same belief under random gaze.

    Args:
        config: of the run; its policies are `target-evidence`.
    """

    task: ClassVar[Task] = "search"
    config: SearchConfig

    def __init__(self, config: SearchConfig) -> None:
        context = config.belief.context
        check(context == "none", "belief.context", "none: decisions are by evidence alone", context)
        super().__init__(config)
        evidence = self.models.evidence
        assert evidence is not None
        self.compared = {
            "target-evidence": Strategy(Target(evidence), NonPredictive()),
            "random gaze": Strategy(Target(evidence), Random()),
        }

    def _key(self) -> str:
        evidence = self.models.evidence
        assert evidence is not None
        what = ["decisions", super()._key(), asdict(evidence.thresholds) if evidence.thresholds else None]
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
            sharp = self.eye.detector(self.scenes[index].image[None])
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
            }
            for name, strategy in self.compared.items():
                looks = StoredLooks(detections, grid, torch.tensor([target]))
                with torch.inference_mode():
                    steps = self._search(strategy, looks, cell, noise, target)
                last, seen = steps[-1], torch.cat([step.cell for step in steps])
                outcome = OUTCOMES[int(decide(last, target, self._thresholds(strategy)))]
                found = outcome == "found"
                best = int(last.belief.probability(target).argmax())
                box = best_box([detections[place] for place in seen.split(1)], grid, best, target) if found else None
                records.append(
                    {
                        "policy": name,
                        **common,
                        "outcome": outcome,
                        "probability": float(last.belief.presence(target)),
                        "looks": len(steps),
                        "right_place": bool(goal[best]) if found else None,
                        "overlap": overlap(box, annotation.boxes[annotation.labels == target]),
                        "landing": landing([step.belief for step in steps], seen, goal, target),
                    }
                )
        watch.lap("search")
        return records, watch.seconds

    def _thresholds(self, strategy: Strategy) -> Thresholds:
        return strategy.observer.thresholds or Thresholds(0.9, 0.05)

    def _search(self, strategy: Strategy, looks: StoredLooks, start: Tensor, noise: Tensor, target: int) -> list[Step]:
        thresholds = self._thresholds(strategy)
        return list(
            rollout(
                looks,
                strategy.observer,
                strategy.policy(target, looks.grid),
                start,
                Greedy(drawn_from(noise)),
                most=self.config.protocol.shifts + 1,
                ends=lambda step: decide(step, target, thresholds) > 0,
            )
        )


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
