"""The models that are fitted to a detector: each part is fitted, compared with raw scores, and written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import torch

from semfov.belief.grid import Grid
from semfov.belief.observers import LearnedMap, Observer, Semantic, Target
from semfov.decision import decide
from semfov.episode import Step
from semfov.errors import DataError, InputError
from semfov.experiments.config import ProtocolConfig
from semfov.experiments.run import digest_of
from semfov.experiments.samples import Samples, cells_of
from semfov.experiments.seeds import generator_for
from semfov.gaze.policies import Closer, NonPredictive, Policy, Random
from semfov.io.files import sha256, write_text
from semfov.io.manifest import Part
from semfov.metrics.calibration import calibration, surprisal
from semfov.model_folder import KINDS, Model
from semfov.observation.foveal import FovealObservationModel
from semfov.strategy import Strategy
from semfov.training.detector_settings import FitDetectorConfig
from semfov.training.detector_words import curves_figure, in_words, mean_percent, section, share
from semfov.training.evidence import fit_evidence, judge
from semfov.training.evidence import report as judged_report
from semfov.training.evidence_examples import LookingRun, make_examples
from semfov.training.held_out import Difference, Rule, by_detection, decisions, explore_curves, search_curves
from semfov.training.map_evidence import fit_map_evidence
from semfov.training.misses import count_misses
from semfov.training.observation import fit_model
from semfov.training.tempering import hit_rates, means_of
from semfov.viz.style import save_figure

SHIFTS = 5
"""Gaze shifts after which searches and explorations are compared."""
LONGEST = 15
"""Maximum number of gaze shifts in them."""
ABSENT = 1000
"""Thresholds are chosen on about this many searches for absent classes, at most 20 in a photograph."""
SUREST, SUREST_OF_FEW = 0.99, 0.9
"""Upper limit of the threshold for reporting a target as found. The second value is for few expected false alarms.

If the threshold were higher than any search reaches, nothing would ever be found. With few searches, a single false
alarm could push it that high.
"""


@dataclass(frozen=True)
class Fitted:
    """A fitted part with its report.

    Attributes:
        part: the part's entry in the manifest of the folder.
        report: report in Markdown.
        figures: names of its figures in the folder.
    """

    part: Part
    report: str
    figures: list[str] = field(default_factory=list)


class Workshop:
    """Fit the parts to a detector. Parts that an earlier run finished are read from the folder.

    Args:
        config: the settings.
        run: the finished looks from every cell of all photographs.
    """

    def __init__(self, config: FitDetectorConfig, run: LookingRun) -> None:
        self.config, self.run = config.sized(len(run.scenes)), run
        self.components = len(run.scenes.classes) + 1
        self.holdout = self.config.observation.holdout
        self.held_out = [index for index in range(len(run.scenes)) if index % self.holdout == 0]
        self.parts: dict[str, Fitted] = {}

    @property
    def stages(self) -> dict[str, dict[str, float]]:
        """The tasks of each part, with an estimate of their seconds on one core."""
        photographs, judged = len(self.run.scenes), min(len(self.held_out), self.config.judged)
        described = {"describing looks": 0.05 * photographs}
        config = self.config
        tried = [f"{scores} {t:g}" for scores in ("raw", "calibrated") for t in config.tempering.exponents]
        evidence, everything = config.evidence(self.components - 1), config.map
        return {
            "observation": {"fitting": 1 + 0.1 * photographs},
            "tempering": dict.fromkeys(tried, 0.005 * photographs),
            "evidence": {**described, "training": 0.1 * evidence.steps, "searching": judged, "deciding": judged},
            "map": {
                **described,
                "training": 0.25 * everything.steps,
                "learning the gain of looks": 0.1 * everything.gain_steps,
                "exploring": judged,
            },
        }

    def _settings(self, name: str) -> list[Any]:
        """List everything except the looks that a part and its evaluation depend on."""
        if name == "evidence":
            own: Any = self.config.evidence(self.components - 1)
        else:
            own = getattr(self.config, name)
        before = [self.parts[other].part.sha256 for other in self.parts]
        before += [_plain(asdict(each.part)) for each in self.parts.values() if each.part.settings]
        return [name, _plain(asdict(own)), self.config.judged, before]

    def fit(self, name: str) -> Fitted:
        """Fit a part, or read it from the folder if it was fitted with the same settings, photographs and code."""
        key = digest_of([self.run.key, self._settings(name)])
        kept = self._kept(name, key)
        if kept is None:
            made: Callable[[], Fitted] = getattr(self, f"_{name}")
            try:
                kept = made()
            except (DataError, InputError) as error:
                kept = Fitted(Part(None, None, False, f"could not be fitted: {error}"), f"Could not be fitted: {error}")
            write_text(self._record(name), json.dumps({"key": key, **asdict(kept)}))
        self.parts[name] = kept
        return kept

    def _record(self, name: str) -> Path:
        return self.config.out / "progress" / f"{name}.json"

    def _kept(self, name: str, key: str) -> Fitted | None:
        try:
            record = json.loads(self._record(name).read_text(encoding="utf-8"))
            part = Part(**record["part"])
            whole = record["key"] == key
            whole = whole and (part.file is None or sha256(self.config.out / part.file) == part.sha256)
            whole = whole and all((self.config.out / figure).is_file() for figure in record["figures"])
        except Exception:  # a damaged record is no problem, as the part can be fitted again
            return None
        return Fitted(part, record["report"], record["figures"]) if whole else None

    def _write(self, name: str, model: Model, used: bool, why: str) -> Part:
        """Write the model of a part and return its entry in the manifest."""
        file = f"{name}.safetensors"
        model.save(self.config.out / file)
        return Part(file, sha256(self.config.out / file), used, why)

    def model(self, name: str) -> Model | None:
        """Return the model of a part, or None if the part has no model or the agent should not use it."""
        part = self.parts[name].part
        return KINDS[name].from_pretrained(self.config.out / part.file) if part.used and part.file else None

    @property
    def semantic(self) -> Semantic:
        """The belief that fuses scores with the best exponent."""
        part = self.parts["tempering"].part
        if not part.used:
            return Semantic(self.components)
        return self._fusing(part.settings["scores"], part.settings["exponent"])

    def _fusing(self, scores: str, tempering: float) -> Semantic:
        model = self.model("observation") if scores == "calibrated" else None
        assert model is None or isinstance(model, FovealObservationModel)
        footprint = self.config.tempering.footprint
        return Semantic(self.components, model, footprint=footprint, tempering=tempering)

    @cached_property
    def samples(self) -> Samples:
        """Labelled detections from a few random cells of each photograph."""
        parts, run = [], self.run
        for index in range(len(run.scenes)):
            grid = run.grid(index)
            generator = generator_for("cells", self.config.seed, run.scenes.ids[index])
            cells = torch.randperm(len(grid), generator=generator)[: self.config.fixations]
            seen, annotation = run.detections(index)[cells], run.scenes.annotation(index)
            parts.append(Samples.of(seen, grid.centres[cells], annotation, index, self.config.observation.iou))
        return Samples.join(parts)

    def _observation(self) -> Fitted:
        config, run, samples = self.config.observation, self.run, self.samples
        held_out = samples.scene % config.holdout == 0
        judged = samples[held_out]
        if not len(judged) or len(judged) == len(samples):
            raise DataError(
                f"data: expected detections both in the training and in the held-out photographs, got {len(samples)} "
                "detections in all; give more photographs"
            )
        model = fit_model(config, run, samples[~held_out])
        fitted_on = {index for index in range(len(run.scenes)) if index % config.holdout}
        cells = cells_of(self.config.columns, self.config.rows)
        misses = count_misses(run.scenes, samples, fitted_on, model.edges, cells)
        model.miss_rate = misses.rates().to(model.edges)
        raw = FovealObservationModel.identity(run.scenes.classes, config.edges).eval()
        with torch.inference_mode():
            posteriors = {
                name: m.calibrate(judged.scores, judged.distance) for name, m in (("raw", raw), ("fitted", model))
            }
        cost = {name: surprisal(p.double().gather(1, judged.labels[:, None])[:, 0]) for name, p in posteriors.items()}
        photographs = judged.scene.unique().tolist()
        means = {
            name: torch.stack([each[judged.scene == scene].mean() for scene in photographs]).numpy()
            for name, each in cost.items()
        }
        gain = Difference.of(means["raw"], means["fitted"])
        figures = {name: calibration(p, judged.labels) for name, p in posteriors.items()}
        rows = [["scores", "NLL", "Brier", "ECE", "accuracy"]]
        rows += [
            [name, f"{f.nll:.3f}", f"{f.brier:.3f}", f"{f.ece:.3f}", f"{f.accuracy:.3f}"] for name, f in figures.items()
        ]
        why = (
            f"negative log likelihood of the true class {figures['fitted'].nll:.3f}, with raw scores "
            f"{figures['raw'].nll:.3f}; {in_words(gain, 'nats gained')}"
        )
        from semfov.viz import plot_reliability

        figure = plot_reliability({name: (p, judged.labels) for name, p in posteriors.items()})
        save_figure(figure, self.config.out / "reliability.png")
        report = section(
            f"Predicted probability of the true class of a detection: fitted on {len(samples) - len(judged)} "
            f"detections, evaluated on {len(judged)} detections in {len(photographs)} held-out photographs.",
            rows,
        )
        part = self._write("observation", model, gain.better, why)
        return Fitted(part, report, ["reliability.png"])

    def _tempering(self) -> Fitted:
        config, run = self.config.tempering, self.run
        ways = ["raw"] if self.model("observation") is None else ["raw", "calibrated"]
        baseline = Semantic(self.components)
        raw = hit_rates(config, run.scenes, self.samples, baseline, "raw")
        rates = {
            (scores, exponent): hit_rates(
                config, run.scenes, self.samples, self._fusing(scores, exponent), f"{scores} {exponent:g}"
            )
            for scores in ways
            for exponent in config.exponents
        }
        means = {way: means_of(config, each) for way, each in rates.items()}
        scores, exponent = best = max(means, key=lambda way: means[way]["fitted"])
        held_out = [index for index in raw if index % config.holdout == 0]
        chosen = rates[best]
        gain = Difference.of(
            torch.tensor([chosen[index] for index in held_out]).numpy(),
            torch.tensor([raw[index] for index in held_out]).numpy(),
        )
        before = means_of(config, raw)["held_out"]
        why = (
            f"{100 * means[best]['held_out']:.1f} % of the next fixations hit the target with {scores} scores to the "
            f"power of {exponent:g}, {100 * before:.1f} % with raw scores; {in_words(gain, 'points gained', 100)}"
        )
        rows = [["scores", "exponent", "next fixations that hit, %"], ["raw, every cell of a box", "1", share(before)]]
        rows += [[way[0], f"{way[1]:g}", share(mean["held_out"])] for way, mean in means.items()]
        report = section(
            f"The exponent with which scores are fused ({scores}, {exponent:g}) was chosen on the training "
            f"photographs; the table shows results on {len(held_out)} held-out photographs.",
            rows,
        )
        settings = {"scores": scores, "exponent": exponent, "footprint": config.footprint}
        return Fitted(Part(None, None, gain.better, why, settings), report)

    def _evidence(self) -> Fitted:
        config, run = self.config.evidence(self.components - 1), self.run
        fit = fit_evidence(config, run)
        grid = Grid(config.columns, config.rows, (config.columns, config.rows))
        # More searches for absent classes give a more precise share of false alarms, and there are many such classes.
        each = max(config.classes, min(20, ABSENT // len(self.held_out)))
        area, scenes = config.max_target_area, self.held_out
        wide = make_examples(run, config.classes, area, config.seed, absent=each, scenes=scenes)
        expected = config.false_alarms * int((~wide.goal.any(-1)).sum())
        surest = SUREST_OF_FEW if expected < 10 else SUREST
        _, fit.model.thresholds = judge(replace(config, surest=surest), fit.model, wide, grid)
        thresholds = fit.model.thresholds
        learned = _strategy(Target(fit.model), NonPredictive())
        ways = {
            "fitted": learned,
            "raw": _strategy(Semantic(self.components), NonPredictive()),
            "fused": _strategy(self.semantic, NonPredictive()),
        }
        protocol = ProtocolConfig(shifts=min(LONGEST, config.columns * config.rows - 1), seed=config.seed)
        judged = self.held_out[: self.config.judged]
        curves = search_curves(run, judged, ways, protocol, config.max_target_area)
        if not len(curves["raw"]):
            raise DataError("data: none of the held-out photographs contains a class to search for; give more of them")
        at = min(SHIFTS, protocol.shifts)
        gain = Difference.of(curves["fitted"][:, at], curves["raw"][:, at])
        why = (
            f"{100 * curves['fitted'][:, at].mean():.1f} % of the targets are found in {at} gaze shifts, "
            f"{100 * curves['raw'][:, at].mean():.1f} % with raw scores; {in_words(gain, 'points gained', 100)}"
        )
        rules: dict[str, tuple[Strategy, Rule]] = {
            "fitted": (learned, partial(_by_thresholds, thresholds=thresholds)),
            "raw": (ways["raw"], by_detection),
        }
        decided = decisions(run, judged, rules, protocol, config.classes, config.max_target_area)
        shifts = (1, at, protocol.shifts)
        rows = [["belief", *(f"CP@{n}" for n in shifts)]]
        rows += [[name, *(mean_percent(curve[:, n]) for n in shifts)] for name, curve in curves.items()]
        outcomes = [["belief", "found, present, %", "found, absent, %", "undecided, %", "looks"]]
        outcomes += [
            [name, share(d.found), share(d.false_alarms), share(d.undecided), f"{d.looks:.1f}"]
            for name, d in decided.items()
        ]
        report = "\n".join(
            [
                section(
                    f"Targets found after n gaze shifts, in %, on {len(curves['raw'])} held-out photographs with "
                    f"{protocol.starts} starting points for each target. `raw` fuses the raw scores; `fused` uses the "
                    "exponent chosen under Tempering.",
                    rows,
                ),
                section(
                    f"Decisions of {decided['fitted'].searches} searches for present and for absent classes. A target "
                    f"counts as found from a probability of {thresholds.confirm:.2f} on, and a search gives up when no "
                    f"cell has a probability of {thresholds.give_up:.2f} or more. These thresholds were chosen on the "
                    "same photographs. With raw scores, a score of 0.5 in the fixated cell counts as found, and no "
                    "search gives up.",
                    outcomes,
                ),
                judged_report(fit.judged, thresholds, fit.trained, fit.held_out),
            ]
        )
        figure = curves_figure(curves, "search")
        save_figure(figure, self.config.out / "search.png")
        part = self._write("evidence", fit.model, gain.better, why)
        return Fitted(part, report, ["search.png"])

    def _map(self) -> Fitted:
        config, run = self.config.map, self.run
        if self.components < 3:
            raise InputError("detector: a map of all classes needs at least 2 classes, got a detector with 1 class")
        fit = fit_map_evidence(config, run)
        fovea = self.config.sensor.fovea
        ways = {
            "fitted": _strategy(LearnedMap(fit.model), Closer(fovea)),
            "raw": _strategy(Semantic(self.components), Random()),
            "fused": _strategy(self.semantic, Closer(fovea)),
        }
        protocol = ProtocolConfig(shifts=min(LONGEST, config.columns * config.rows - 1), seed=config.seed)
        curves = explore_curves(run, self.held_out[: self.config.judged], ways, protocol)
        at = min(SHIFTS, protocol.shifts)
        every, objects = curves["all"], curves["objects"]
        if not len(objects["raw"]):
            raise DataError("data: none of the held-out photographs contains an object; give more photographs")
        gain = Difference.of(objects["fitted"][:, at], objects["raw"][:, at])
        # A map that answers background everywhere is right for most cells, and one that never answers background may
        # be right for all objects. Therefore both measures are compared.
        loss = Difference.of(every["raw"][:, at], every["fitted"][:, at])
        why = (
            f"{100 * objects['fitted'][:, at].mean():.1f} % of the cells with objects are classified correctly after "
            f"{at} gaze shifts, {100 * objects['raw'][:, at].mean():.1f} % with raw scores and random gaze; "
            f"{in_words(gain, 'points gained', 100)}; of all cells {100 * every['fitted'][:, at].mean():.1f} and "
            f"{100 * every['raw'][:, at].mean():.1f} %"
        )
        sections = []
        for what, words in (("objects", "cells with objects, the published success rate"), ("all", "all cells")):
            rows = [["map", *(f"after {n}" for n in (1, at, protocol.shifts))]]
            rows += [
                [name, *(mean_percent(curve[:, n]) for n in (1, at, protocol.shifts))]
                for name, curve in curves[what].items()
            ]
            sections.append(section(f"Classified correctly after n gaze shifts, in % of {words}:", rows))
        head = (
            f"On {len(objects['raw'])} held-out photographs. `raw` fuses raw scores with random gaze; `fused` uses the "
            "exponent chosen under Tempering, with the gaze policy of the fitted map. The answer for a cell may be "
            "background.\n"
        )
        save_figure(curves_figure(objects, "exploration"), self.config.out / "explore.png")
        part = self._write("map", fit.model, gain.better and not loss.better, why)
        return Fitted(part, "\n".join([head, *sections, fit.report]), ["explore.png"])


def _strategy(observer: Observer, policy: Policy) -> Strategy:
    return Strategy(observer, policy).eval().requires_grad_(False)


def _by_thresholds(step: Step, target: int, grid: Grid, *, thresholds: Any) -> torch.Tensor:
    return decide(step, target, thresholds)


def _plain(settings: dict[str, Any]) -> Any:
    """Return the settings that a part depends on, as JSON values."""
    left_out = ("out", "cache", "workers")
    return json.loads(json.dumps({name: each for name, each in settings.items() if name not in left_out}, default=str))
