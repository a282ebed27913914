"""How often the target is there: `python -m eval.prior` measures probabilities of one class over many photographs.

    python -m eval.prior --data.root DIR --data.annotations instances.json --detector.name yolox-nano --out runs/prior

Without photographs it uses the embedded scenes. All photographs are searched by windows for each of the classes that
are in most of them: with the share of the searches of the fit, with one half, and with the share of the photographs
that hold the class. Then each one is searched for some classes that are drawn evenly from all, likewise, and for one
that it holds and one that it does not hold, whose share is one half. The table has the mean probability, the Brier
score, the expected calibration error, the area under ROC and the decisions beside the share of the searches whose
target is there, and the difference of the Brier score to that with the share of the fit, paired over the photographs.
`best` is the Brier score after an offset and a slope of the log odds that are fitted to these searches themselves: what
is left is ranking, not calibration. With `--enlarged 4` the same photographs have as many pixels as those of a camera,
and are searched as large pictures. If the command is stopped, repeat it to continue.
"""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from eval.bootstrap import Bootstrap
from eval.comparison.records import gather, grouped
from eval.comparison.summary import announce, write_summary
from semfov.agents.episode import EpisodeLimits, Goal
from semfov.agents.window_episode import PASSES, WindowEpisode, WindowTask
from semfov.agents.windows import window_eye
from semfov.belief.prior import PriorLike
from semfov.data.classes import class_index
from semfov.data.scene import Annotation, Scene, Scenes
from semfov.episode.stopwatch import Stopwatch
from semfov.fit.logistic import logistic_regression
from semfov.io.files import json_sha256
from semfov.io.ranges import Count, Seed, Share, Whole
from semfov.metrics.calibration import BinarySums
from semfov.metrics.episodes import area_under_roc
from semfov.runs.command import command
from semfov.runs.config import DataConfig, DetectorConfig, WorkConfig
from semfov.runs.protocols import choose_classes
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import SceneRun, finish
from semfov.runs.seeds import generator_for
from semfov.runs.setup import check_sources, make_detector, make_scenes
from semfov.runs.tables import plus_minus, share, table
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.settings import DecisionSettings
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.looks import WindowLooks

RANDOM, PAIR = "a class drawn from all", "one there, one not"
"""Names of the questions that are not about one class."""

_ALWAYS = "always "  # begins the names of the questions about one class

_MISSING = {_ALWAYS: "one of these classes, not there", PAIR: "the one that is not there"}
"""Names for the searches without their target, by how the names of their questions begin."""

_DECIDED = ("right", "wrong", "undecided", "found, there", "absent, there", "found, not there", "absent, not there")

_PRIORS = {"fit": "fit", "half": "0.5", "share": "share"}
"""The priors of a search, by their names in the records, as the table names them."""


@dataclass(frozen=True)
class PriorConfig(WorkConfig):
    """Search many photographs for the same class.

    Args:
        data: the photographs.
        classes: classes to search all photographs for, by name (None: the `commonest`).
        commonest: number of classes, those that most photographs hold, that all photographs are searched for.
        drawn: number of classes, drawn evenly from all, that each photograph is searched for.
        max_target_area: share of a photograph that a class covers at most to be searched for in pairs of one that is
            there and one that is not.
        windows: evidence for windows, by name or file (None: the one that is shipped for the detector).
        enlarged: factor by which photographs are enlarged first.
        seed: seed of the classes that are drawn.
        out: folder for the table and the records.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(name="yolox-nano"))
    classes: tuple[str, ...] | None = None
    commonest: Count = 11
    drawn: Whole = 3
    max_target_area: Share = 0.2
    windows: str | None = None
    enlarged: Count = 1
    seed: Seed = 0
    out: Path = Path("runs/prior")


class EnlargedScenes(Scenes):
    """Photographs that are enlarged: the same scenes with as many pixels as a camera's, though not as sharp.

    Args:
        scenes: the photographs.
        factor: by which their sides grow.
    """

    def __init__(self, scenes: Scenes, factor: int) -> None:
        self.scenes = scenes
        self.factor = factor
        self.classes = scenes.classes
        self.ids = scenes.ids
        self.fingerprint = json_sha256([scenes.fingerprint, factor])

    def __getitem__(self, index: int) -> Scene:
        scene = self.scenes[index]
        enlarged = F.interpolate(scene.image[None], scale_factor=self.factor, mode="bicubic")[0].clamp(0, 1)
        return replace(scene, image=enlarged, boxes=scene.boxes * self.factor)

    def digest(self, index: int) -> str:
        return json_sha256([self.scenes.digest(index), self.factor])

    def annotation(self, index: int) -> Annotation:
        annotation = self.scenes.annotation(index)
        width, height = annotation.size
        return replace(
            annotation, boxes=annotation.boxes * self.factor, size=(width * self.factor, height * self.factor)
        )


class PriorRun(SceneRun):
    """Searches of photographs for the commonest classes, for drawn ones, and for pairs of classes."""

    config: PriorConfig

    def __init__(self, config: PriorConfig) -> None:
        self.config = config
        check_sources(config.data, config.detector)
        detector = make_detector(config.detector)
        self.scenes = make_scenes(config.data, detector.classes)
        if config.enlarged > 1:
            self.scenes = EnlargedScenes(self.scenes, config.enlarged)
        name = detector.name if config.windows is None else config.windows
        self.evidence = GlimpseEvidence.from_pretrained(name).requires_grad_(False)
        self.eye = window_eye(detector, self.evidence).eval().requires_grad_(False)
        self.evidence.check_compatible(self.eye.settings())
        held = torch.zeros(len(self.scenes.classes))
        for index in range(len(self.scenes)):
            held[self.scenes.annotation(index).labels.unique() - 1] += 1
        # Half a photograph for and against: no class is in none of the photographs, or in all.
        self.shares: Tensor = (held + 0.5) / (len(self.scenes) + 1)
        self.always = [int(number) + 1 for number in held.argsort(descending=True)[: config.commonest]]
        if config.classes is not None:
            self.always = [class_index(name, self.scenes.classes, "classes") for name in config.classes]

    def depends_on(self) -> dict[str, Any]:
        config = self.config
        settings = [config.classes, config.commonest, config.drawn, config.max_target_area, config.seed]
        return {"eye": self.eye.settings(), "settings": settings, "windows": self.evidence}

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        watch = Stopwatch()
        annotation = self.scenes.annotation(index)
        source = StoredWindowLooks(self.eye, self.scenes, index, None)
        generator = generator_for("prior", self.config.seed, self.scenes.ids[index])
        drawn = (torch.randperm(len(self.scenes.classes), generator=generator) + 1)[: self.config.drawn].tolist()
        pair = choose_classes(self.scenes, index, annotation, 1, self.config.max_target_area, self.config.seed)
        questions = [(f"{_ALWAYS}{self.scenes.classes[target - 1]}", target) for target in self.always]
        questions += [(RANDOM, target) for target in drawn]
        questions += [(PAIR, target) for target in pair]
        records = []
        for question, target in questions:
            priors: dict[str, PriorLike] = {"fit": "fit", "half": 0.5}
            if question != PAIR:
                priors["share"] = float(self.shares[target - 1])
            records.append(
                {
                    "scene": self.scenes.ids[index],
                    "question": question,
                    "target": self.scenes.classes[target - 1],
                    "present": bool((annotation.labels == target).any()),
                    **{way: self._search(source, target, prior) for way, prior in priors.items()},
                }
            )
        watch.lap("search")
        return records, watch.seconds

    def _search(self, source: WindowLooks, target: int, prior: PriorLike) -> ResultRecord:
        """Search the photograph for a class, and record the decision."""
        limits = EpisodeLimits(PASSES)
        names = ("background", *self.scenes.classes)
        task = WindowTask(Goal.of(names, target), self.evidence, DecisionSettings(prior=prior))
        path = WindowEpisode(task, source, limits).run()
        decision = path.decision
        assert decision is not None
        return {"outcome": decision.outcome, "probability": decision.probability, "passes": path.passes}


def prior_summary(records: Iterable[ResultRecord]) -> str:
    """Write the table, as Markdown."""
    by_question = grouped(records, "question")
    missing = {name: _without_target(by_question, beginning) for beginning, name in _MISSING.items()}
    by_question |= missing
    heads = ["mean p", "Brier", "difference", "best", "ECE", "area", *_DECIDED, "passes"]
    rows = [["searches for", "`prior=`", "number", "there", *heads]]
    for question, group in by_question.items():
        there = torch.tensor([record["present"] for record in group])
        frequency = f"{float(there.double().mean()):.3f}"
        for way, name in _PRIORS.items():
            if group and way in group[0]:
                rows.append([question, name, str(len(group)), frequency, *_measured(group, way)])
    return "\n".join(
        [
            "Probability that a photograph holds the class: with the share of the searches of the fit, with one half, "
            "and with the share of the photographs that hold it. `there`: share of the searches whose target is there. "
            "Right, wrong and undecided are in % of all searches, the other decisions in % of those whose target is "
            "there, and of those whose target is not.",
            "",
            *table(rows),
            "",
        ]
    )


def _without_target(by_question: Mapping[str, Sequence[ResultRecord]], beginning: str) -> list[ResultRecord]:
    """List the searches whose target is not there, of all questions whose names begin so."""
    searches: list[ResultRecord] = []
    for question, group in by_question.items():
        if question.startswith(beginning):
            searches += [record for record in group if not record["present"]]
    return searches


def _measured(records: Sequence[ResultRecord], way: str) -> list[str]:
    """Measure probabilities, in the order of the headings, and count decisions and passes."""
    there = torch.tensor([record["present"] for record in records])
    probability = torch.tensor([record[way]["probability"] for record in records], dtype=torch.float64)
    brier, difference = _brier(records, way, there)
    area = "-"
    best = "-"
    if there.any() and not there.all():
        area = f"{area_under_roc(probability, there):.3f}"
        best = f"{_best_brier(probability, there):.3f}"
    passes = sum(record[way]["passes"] for record in records) / len(records)
    return [
        f"{float(probability.mean()):.3f}",
        brier,
        difference,
        best,
        f"{BinarySums.of(probability, there).ece:.3f}",
        area,
        *_decided(records, way),
        f"{passes:.1f}",
    ]


def _brier(records: Sequence[ResultRecord], way: str, there: Tensor) -> tuple[str, str]:
    """Write the Brier score, and its difference to the one with the prior of the fit, paired over photographs."""
    squares = []
    for prior in (way, "fit"):
        probability = torch.tensor([record[prior]["probability"] for record in records], dtype=torch.float64)
        squares.append((probability - there.double()).square())
    errors = torch.stack(squares)  # (2, M)
    brier = Bootstrap.of(lambda chosen: errors[:, chosen].mean(1), [record["scene"] for record in records])
    score = plus_minus(float(brier.value[0]), float(brier.error[0]), 3)
    if way == "fit":
        return score, ""
    apart = brier.less(1)
    return score, plus_minus(float(apart.value[0]), float(apart.error[0]), 3, sign="+")


def _best_brier(probability: Tensor, there: Tensor) -> float:
    """Compute the Brier score after the best offset and slope of the log odds of probabilities `(n,)`."""
    log_odds = probability.logit(1e-6)
    offset, slope = logistic_regression(log_odds[:, None], there, ridge=0.0)
    return BinarySums.of((slope * log_odds + offset).sigmoid(), there).brier


def _decided(records: Sequence[ResultRecord], way: str) -> list[str]:
    """Write which % end right, wrong and undecided, and found and absent where the target is there and where not."""
    of_present = [record[way]["outcome"] for record in records if record["present"]]
    of_absent = [record[way]["outcome"] for record in records if not record["present"]]
    right = of_present.count("found") + of_absent.count("absent")
    undecided = of_present.count("undecided") + of_absent.count("undecided")
    wrong = len(records) - right - undecided
    cells = [share(count, len(records)) for count in (right, wrong, undecided)]
    for outcomes in (of_present, of_absent):
        cells += [share(outcomes.count("found"), len(outcomes)), share(outcomes.count("absent"), len(outcomes))]
    return cells


def measure_priors(config: PriorConfig) -> None:
    """Search all photographs, and write the table and the records."""
    run = PriorRun(config)
    finish(run, "searching")
    records = [*gather(run)]
    text = prior_summary(records)
    announce(text, write_summary(config.out, "prior", text, records))


main = command(measure_priors, PriorConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
