"""Fitting evidence by magnification on mosaics of photographs."""

import json
import logging
import random
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.data.mosaics import Mosaics
from semfov.errors import check
from semfov.experiments.parallel import available_cores, run_tasks
from semfov.experiments.run import cache_folder
from semfov.experiments.setup import make_detector, prepare_worker, split_photographs
from semfov.experiments.summary import table as table_of
from semfov.experiments.zoom import SHOWN
from semfov.experiments.zoom_store import GlanceStore, open_scene
from semfov.io.files import inside
from semfov.training.outputs import training_of, write_outputs
from semfov.training.zoom_choice import choose_foresight, choose_patience, open_all
from semfov.training.zoom_decision import fit_judge, judge_searches, search_mosaics
from semfov.training.zoom_examples import LookedAt, ZoomExample, example_of, windows_of
from semfov.training.zoom_settings import FitZoomConfig, Part
from semfov.training.zoom_survey import SurveyExample, fit_survey, judge_survey
from semfov.zoom.belief import before_of
from semfov.zoom.evidence import GlimpseEvidence, pool
from semfov.zoom.eye import ZoomEye
from semfov.zoom.networks import STEPS
from semfov.zoom.survey import Survey

DECIDING = ("searched", "judged", "sought", "passes", "judging", "false_alarms", "surest", "lost", "tile", "seed")
"""Settings that thresholds and the probability of presence depend on."""

SURVEYING = ("mosaics", "far", "judged", "judged_far", "survey_steps", "tile", "seed")
"""Settings that the survey depends on."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Windows:
    """Looks and the closer windows that they tell of, as one table.

    Attributes:
        scores: `(N, K)`, strongest hints in the window.
        summary: `(N, 3)`.
        steps: `(N,)`, octaves to the closer look.
        shown: `(N, K)`, whether it showed the class.
        before: `(N,)`, row of the overview for the same window; -1 for the overview's own.
        slot: `(N,)`, whether the window is a photograph of the mosaic.
        mosaic: `(N,)`.
    """

    scores: Tensor
    summary: Tensor
    steps: Tensor
    shown: Tensor
    before: Tensor
    slot: Tensor
    mosaic: Tensor


def make_eye(config: FitZoomConfig) -> ZoomEye:
    """The eye that looks at the mosaics."""
    return ZoomEye(make_detector(config.detector)).eval().requires_grad_(False)


def make_mosaics(config: FitZoomConfig, classes: tuple[str, ...]) -> dict[str, Mosaics]:
    """Mosaics to fit on, near and far, and those of photographs that were held out."""
    kept, held = split_photographs(config.data, classes, 5)
    tile = config.tile, config.tile * 3 // 4
    return {
        "near": Mosaics(kept, 4, 4, tile=tile, count=config.mosaics, seed=config.seed),
        "far": Mosaics(kept, 8, 6, tile=tile, count=config.far, seed=config.seed + 1),
        "judged": Mosaics(held, 4, 4, tile=tile, count=config.judged, seed=config.seed + 2),
        "judged far": Mosaics(held, 8, 6, tile=tile, count=config.judged_far, seed=config.seed + 3),
        "searched": Mosaics(kept, 4, 4, tile=tile, count=config.searched, seed=config.seed + 4),
    }


def make_store(config: FitZoomConfig, eye: ZoomEye) -> GlanceStore:
    """Where looks at mosaics are kept."""
    return GlanceStore(cache_folder(config.cache) / "glances", eye.settings(), len(eye.detector.classes))


_process: dict[str, Any] = {}


def prepare_process(config: FitZoomConfig) -> None:
    """Build eye, mosaics and store once in this process."""
    prepare_worker()
    eye = make_eye(config)
    _process.update(eye=eye, mosaics=make_mosaics(config, eye.detector.classes), store=make_store(config, eye))


def look(task: tuple[str, int]) -> tuple[str, int]:
    """Look at a mosaic, where that was not done before."""
    kind, index = task
    mosaics = _process["mosaics"][kind]
    glances = open_scene(_process["eye"], mosaics, index, _process["store"])
    glances.see(windows_of(mosaics, index, glances.lattice))
    glances.save()
    return task


def read_examples(mosaics: Mosaics, store: GlanceStore, eye: ZoomEye) -> list[ZoomExample]:
    """What was seen of all mosaics."""
    return [example_of(mosaics, n, open_scene(eye, mosaics, n, store)) for n in range(len(mosaics))]


def table(examples: list[ZoomExample]) -> Windows:
    """Every look beside every closer window in it."""
    rows: list[tuple[Tensor, Tensor, int, Tensor, int, bool, int]] = []
    for number, example in enumerate(examples):
        first: dict[int, int] = {}
        for told in example.looks:
            look = told.gist
            if look is None:
                continue
            high, wide = (n * look.scale for n in look.scores.shape[:2])
            for place, closer in enumerate(example.looks):
                steps = closer.window.level - look.level
                x1, y1, x2, y2 = closer.window.cells
                x1, y1, x2, y2 = x1 - look.first[0], y1 - look.first[1], x2 - look.first[0], y2 - look.first[1]
                inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
                if not 1 <= steps <= STEPS or not (inside or look.level == 0):
                    continue
                box = x1 // look.scale, y1 // look.scale, -(-x2 // look.scale), -(-y2 // look.scale)
                pooled, summary = pool(look.scores, box)
                before = -1 if look.level == 0 else first.get(place, -1)
                if look.level == 0:
                    first[place] = len(rows)
                if look.level > 0 and before < 0:
                    continue
                slot = closer.window.within is not None
                rows.append((pooled, summary, steps, closer.show >= SHOWN, before, slot, number))
    columns: list[Any] = [*zip(*rows, strict=True)]
    whole = [torch.tensor(columns[place]) for place in (2, 4, 5, 6)]
    return Windows(torch.stack(columns[0]), torch.stack(columns[1]), whole[0], torch.stack(columns[3]), *whole[1:])


def fit_presence(model: GlimpseEvidence, windows: Windows, steps: int, batch: int = 1024) -> None:
    """Fit what looks say of whether closer ones show a class: mean cross-entropy over windows and classes."""
    own = [model.slope, model.offset, *model.company.parameters(), *model.shape.parameters()]
    optimizer = torch.optim.AdamW(own, lr=8e-3, weight_decay=1.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 8e-3, total_steps=steps)
    first, later = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]
    for _ in range(steps):
        model.train()
        loss = _presence_loss(model, windows, first[torch.randint(len(first), (batch,))])
        if len(later):
            loss = loss + _presence_loss(model, windows, later[torch.randint(len(later), (batch // 2,))])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    model.eval()


def _presence_loss(model: GlimpseEvidence, windows: Windows, rows: Tensor) -> Tensor:
    odds = presence_of(model, windows, rows)
    return F.binary_cross_entropy_with_logits(odds, windows.shown[rows].to(odds))


def presence_of(model: GlimpseEvidence, windows: Windows, rows: Tensor) -> Tensor:
    """Log odds of all classes in rows of one kind: of overviews, or of later looks."""
    before = None
    if bool((windows.before[rows] >= 0).all()):
        training = model.training
        model.eval()
        with torch.no_grad():
            before = presence_of(model, windows, windows.before[rows])
        model.train(training)
    return model.presence(windows.scores[rows], windows.summary[rows], windows.steps[rows], None, before)


def fit_rates(model: GlimpseEvidence, examples: list[ZoomExample], steps: int, batch: int = 4) -> None:
    """Fit how many objects closer looks find: the Poisson likelihood of their number in every window."""
    own = [*model.rate.parameters(), model.prior, model.border]
    optimizer = torch.optim.AdamW(own, lr=6e-3, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 6e-3, total_steps=steps)
    for step in range(steps):
        losses = [rate_loss(model, example) for example in random.sample(examples, min(batch, len(examples)))]
        loss = torch.stack(losses).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(own, 1.0)
        optimizer.step()
        schedule.step()
        if step % 100 == 99:
            _log.info("rates: step %d, loss %.4f", step + 1, float(loss.detach()))


def rate_loss(model: GlimpseEvidence, example: ZoomExample) -> Tensor:
    """Negative log likelihood of what was found in the windows of a mosaic, for some of its classes."""
    shown = torch.stack([look.show for look in example.looks]).amax(0)
    sure, faint = (shown >= SHOWN).nonzero()[:, 0] + 1, ((shown >= 0.02) & (shown < SHOWN)).nonzero()[:, 0] + 1
    targets = torch.cat([_some(sure, 8), _some(faint, 4)])
    looks = [look for look in example.looks if look.gist is not None]
    overview, *others = looks
    logs = _logs(model, overview, targets, None)
    losses = [_told(model, example, overview, logs, targets, overview.found)]
    for told in random.sample(others, min(2, len(others))):
        before = _before(overview, logs.detach(), told)
        seen = overview.found | told.found
        losses.append(_told(model, example, told, _logs(model, told, targets, before), targets, seen))
    return torch.stack(losses).mean()


def _some(values: Tensor, most: int) -> Tensor:
    return values[torch.randperm(len(values))[:most]]


def _logs(model: GlimpseEvidence, told: LookedAt, targets: Tensor, before: Tensor | None) -> Tensor:
    assert told.gist is not None
    return model.rates(told.gist, targets, before)


def _before(overview: LookedAt, logs: Tensor, told: LookedAt) -> Tensor:
    """What the overview says of the cells of a closer look, for looks one octave closer still, `(T, rows, columns)`."""
    first, look = overview.gist, told.gist
    assert first is not None
    assert look is not None
    cells = (logs.exp() / first.scale**2).repeat_interleave(first.scale, -1).repeat_interleave(first.scale, -2)
    rows, columns = (n * look.scale for n in look.scores.shape[:2])
    part = cells[..., look.first[1] : look.first[1] + rows, look.first[0] : look.first[0] + columns]
    source = torch.zeros(part.shape[-2:], dtype=torch.long)
    return torch.stack([before_of(one, source, look) for one in part])


def _told(
    model: GlimpseEvidence, example: ZoomExample, told: LookedAt, logs: Tensor, targets: Tensor, seen: Tensor
) -> Tensor:
    """Mean negative log likelihood over the closer windows in a look."""
    look = told.gist
    assert look is not None
    rates = logs.exp()
    high, wide = look.scores.shape[:2]
    terms = []
    for closer in example.looks:
        steps = closer.window.level - look.level
        x1, y1, x2, y2 = closer.window.cells
        box = [x1 - look.first[0], y1 - look.first[1], x2 - look.first[0], y2 - look.first[1]]
        x1, y1, x2, y2 = (n // look.scale for n in box)
        inside = x1 >= 0 and y1 >= 0 and x2 <= wide and y2 <= high
        if closer.window.within is not None or not 1 <= steps <= STEPS or not (inside or look.level == 0):
            continue
        weight = model.taper(x2 - x1)
        part = rates[:, steps - 1, max(y1, 0) : y2, max(x1, 0) : x2]
        expected = torch.einsum("tyx,y,x->t", part, weight[: part.shape[1]], weight[: part.shape[2]])
        new = example.labels[closer.found & ~seen]
        count = torch.stack([(new == t).sum() if t else torch.tensor(len(new)) for t in targets.tolist()])
        terms.append((expected - count * expected.clamp(min=1e-6).log()).mean())
    return torch.stack(terms).mean() if terms else logs.sum() * 0


def fit_zoom(config: FitZoomConfig) -> None:
    """Look, fit, judge on what was held out, and write the model and a report."""
    eye = make_eye(config)
    mosaics = make_mosaics(config, eye.detector.classes)
    store = make_store(config, eye)
    parts: list[str] = []
    figures = "{}"
    check(len(config.refit) > 0, "refit", "at least one part of the model", config.refit)
    refit: set[Part] = set(config.refit) if config.evidence else {"decision", "survey"}
    examples = look_at_all(config, eye, mosaics, store) if "survey" in refit else {}
    if config.evidence is None:
        model = fit_looks(config, eye, mosaics, examples)
        text, figures = judge(model, examples["judged"])
        tried = choose_patience(model, eye, mosaics["judged"], store)
        parts += [text, f"Chosen: patience {model.patience:g}.", "", *table_of(tried), ""]
    else:
        model = GlimpseEvidence.from_pretrained(config.evidence).requires_grad_(False)
        model.check_compatible(eye.settings())
    if "survey" in refit:
        told = survey_again(config, model, examples)
        figures = json.dumps({**json.loads(figures), **told}, indent=1)
        tried = choose_foresight(model, eye, mosaics["judged"], mosaics["judged far"], store)
        parts += [*figures_of(told), "", f"Chosen: foresight {model.survey.foresight:g}.", "", *table_of(tried), ""]
    if "decision" in refit:
        parts += fit_decision(config, model, eye, mosaics, store)
    path = inside(config.out, f"{eye.detector.name}.safetensors")
    model.save(path)
    write_outputs(config, "\n".join(parts), ("figures.json", figures), path)


def look_at_all(
    config: FitZoomConfig, eye: ZoomEye, mosaics: dict[str, Mosaics], store: GlanceStore
) -> dict[str, list[ZoomExample]]:
    """Look at the mosaics to fit on and at those that were held out; returns the results by kind of mosaic."""
    looked = {kind: mosaics[kind] for kind in ("near", "far", "judged")}
    todo = [(kind, n) for kind, some in looked.items() for n in range(len(some))]
    workers = config.workers or available_cores()
    for _ in run_tasks(look, todo, workers=workers, setup=prepare_process, settings=(config,), title="looking",
                       unit="mosaic"):  # fmt: skip
        pass
    prepare_worker()
    return {kind: read_examples(some, store, eye) for kind, some in looked.items()}


def fit_looks(
    config: FitZoomConfig, eye: ZoomEye, mosaics: dict[str, Mosaics], examples: dict[str, list[ZoomExample]]
) -> GlimpseEvidence:
    """Fit what looks predict of closer ones, class by class."""
    torch.manual_seed(config.seed)
    random.seed(config.seed)
    metadata = {**eye.settings(), **training_of(config, mosaics["near"], "judged")}
    model = GlimpseEvidence(len(eye.detector.classes), metadata=metadata)
    known = examples["near"] + examples["far"]
    fit_presence(model, table(known), config.steps)
    fit_rates(model, known, config.steps)
    return model.eval().requires_grad_(False)


def survey_again(
    config: FitZoomConfig, model: GlimpseEvidence, examples: dict[str, list[ZoomExample]]
) -> dict[str, float]:
    """Fit a new survey, and judge it on mosaics that were held out."""
    torch.manual_seed(config.seed)
    random.seed(config.seed)
    survey = Survey(model.classes, foresight=model.survey.foresight)
    kinds = {kind: [SurveyExample.of(example) for example in some] for kind, some in examples.items()}
    fit_survey(survey, kinds["near"] + kinds["far"], config.survey_steps)
    model.survey = survey.eval().requires_grad_(False)
    model.metadata["survey"] = {name: getattr(config, name) for name in SURVEYING}
    return judge_survey(survey, kinds["judged"])


def fit_decision(
    config: FitZoomConfig, model: GlimpseEvidence, eye: ZoomEye, mosaics: dict[str, Mosaics], store: GlanceStore
) -> list[str]:
    """Fit and choose when a search decides; returns what to report, lines of Markdown."""
    prepare_worker()
    torch.manual_seed(config.seed)
    searches = {
        kind: search_mosaics(
            model,
            mosaics[kind],
            open_all(eye, mosaics[kind], store),
            classes=config.sought,
            passes=config.passes,
            seed=config.seed,
            title=title,
        )
        for kind, title in (("searched", "searching"), ("judged", "searching what was held out"))
    }
    fit_judge(model, searches["searched"], config.judging)
    rows = judge_searches(model, searches["judged"], config)
    assert model.thresholds is not None
    model.metadata["decision"] = {name: getattr(config, name) for name in DECIDING}
    count, told = (len(searches[kind].there) for kind in ("searched", "judged"))
    return [
        f"Whether a picture holds a class, fitted on {count} searches, half of them for what is not there; judged on "
        f"{told} in mosaics of photographs that were held out.",
        "",
        *rows,
        "",
        f"Thresholds: found from {model.thresholds.confirm:.2f}, a look is worth its price from "
        f"{model.thresholds.give_up:g}.",
        "",
    ]


@torch.no_grad()
def judge(model: GlimpseEvidence, examples: list[ZoomExample]) -> tuple[str, str]:
    """Report on mosaics that were held out, as Markdown and as JSON."""
    windows = table(examples)
    first, later = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]
    figures: dict[str, float] = {"cross-entropy, overview": float(_presence_loss(model, windows, first))}
    if len(later):
        figures["cross-entropy, closer looks"] = float(_presence_loss(model, windows, later))
        figures["the same windows by the overview"] = float(_presence_loss(model, windows, windows.before[later]))
    slots = first[windows.slot[first]]
    odds, shown = presence_of(model, windows, slots), windows.shown[slots]
    passes: dict[str, list[int]] = defaultdict(list)
    for mosaic in windows.mosaic[slots].unique():
        here = windows.mosaic[slots] == mosaic
        for target in shown[here].any(0).nonzero()[:, 0].tolist():
            hits = shown[here, target]
            for name, value in (("evidence", odds), ("raw score", windows.scores[slots])):
                order = value[here, target].argsort(descending=True, stable=True)
                passes[name].append(2 + int(hits[order].int().argmax()))
    for name, counts in passes.items():
        figures[f"passes to the first hit, {name}"] = sum(counts) / len(counts)
    losses = torch.stack([rate_loss(model, example) for example in examples])
    figures["rates, mean negative log likelihood"] = float(losses.mean())
    lines = [f"{len(examples)} mosaics of photographs that were held out", ""]
    lines += [*figures_of(figures), ""]
    return "\n".join(lines), json.dumps(figures, indent=1)


def figures_of(figures: Mapping[str, float]) -> list[str]:
    """Figures as a table in Markdown."""
    return ["| what | value |", "|---|---|", *(f"| {name} | {value:.4f} |" for name, value in figures.items())]
