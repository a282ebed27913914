"""Fit a model of how people choose their next fixation, evaluate it on other people and pictures, and report it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from pathlib import Path

import torch
from tqdm import tqdm

from eval.human.habits.gaze_habits import GazeHabits
from eval.human.habits.habits import AGES, EDGES, FittedTerms, Halves, fit_terms, habits_of
from eval.human.habits.viewings import Choices, choices_in, fixated_cells, values_in
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, by_picture, read_osie
from semfov.data.pictures import Pictures
from semfov.data.scene import Scenes
from semfov.detection.load import check_detector
from semfov.episode import StoredLooks
from semfov.errors import DataError, check, lookup
from semfov.eye import Eye
from semfov.fit.outputs import model_path, write_outputs
from semfov.fit.settings import FitConfig
from semfov.gaze.policies import Task
from semfov.runs.config import BeliefConfig, PolicyConfig, RunConfig, SaliencyConfig
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.presets import label
from semfov.runs.settings import Count, Positive
from semfov.runs.setup import prepare_worker
from semfov.runs.tables import table


@dataclass(frozen=True)
class HabitsConfig(FitConfig):
    """Fit a model of how people choose their next fixation.

    Args:
        root: folder of the pictures.
        fixations: JSON file of people's fixations in the pictures, in OSIE's format
            (`semfov.data.fixations.write_osie`).
        detector: the detector that processes the foveated views.
        belief: the grid of the beliefs.
        saliency: settings of the saliency policies.
        policies: exploration policies to compare, as in `eval.explore`.
        save: policy whose model is written (None: the policy that predicts the fitted half best).
        limit: use only the first so many pictures (None: all).
        ridge: penalty on the squares of the weights.
        smoothing: number of fixations added to every cell when the centre bias is counted.
        out: folder for the model and the report.
        cache: folder for the detections from every cell, shared with other runs (None: the user's cache).
    """

    unused = ("data", "seed", "workers", "scheduler")
    root: Path = field(kw_only=True)
    fixations: Path = field(kw_only=True)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    saliency: SaliencyConfig = field(default_factory=lambda: SaliencyConfig(view="picture", reduction="mean"))
    policies: tuple[str | PolicyConfig, ...] = ("kl-raw", "closer-look-raw", "vocus2-raw", "itti-koch-raw")
    save: str | None = None
    limit: Count | None = None
    ridge: Positive = 1.0
    smoothing: Positive = 1.0
    out: Path = Path("runs/habits")


def fit_habits(config: HabitsConfig) -> None:
    """Gather people's choices, fit half of the people on half of the pictures, and evaluate on the others."""
    check(len(config.policies) > 0, "policies", "at least one policy", "none")
    prepare_worker()
    names = [label(choice, "exploration") for choice in config.policies]
    if config.save is not None:
        lookup(config.save, names, "policy to save")
    choices, size, eye = _gather_choices(config)
    columns, rows = config.belief.columns, config.belief.rows
    halves = Halves.of(choices, Grid(columns, rows, size), config.smoothing)
    models = {name: fit_terms(halves, name, config.ridge) for name in [None, *names]}
    best = max(names, key=lambda name: models[name][-1].fitted)
    chosen = models[config.save or best][-1]
    habits = habits_of(chosen, halves)
    habits.metadata |= {"policy": chosen.policy, **eye.settings(), "held_out_bits": chosen.gain, **halves.sizes}
    path = model_path(config, eye.detector.name)
    path.parent.mkdir(parents=True, exist_ok=True)
    habits.save(path)
    text = _habits_report(halves, [model for several in models.values() for model in several], habits)
    figures = [model.figures() for several in models.values() for model in several]
    write_outputs(config, text, ("bits.json", json.dumps(figures, indent=2) + "\n"), path)


def _gather_choices(config: HabitsConfig) -> tuple[Choices, tuple[int, int], Eye]:
    """Gather people's choices with the value that every policy gives to each cell."""
    people = by_picture(read_osie(config.fixations))
    viewing = Viewing(config, list(people)[: config.limit])
    size = people[str(viewing.scenes.ids[0])][0].size
    per_picture = []
    for number, name in enumerate(tqdm(viewing.scenes.ids, desc="looking as people did", unit="picture")):
        per_picture.append(viewing.choices(number, people[str(name)], size))
    return Choices.join(per_picture), size, viewing.eye


class Viewing(PolicyLooking):
    """Compute the values that policies give to the cells of pictures whenever a person chose the next fixation."""

    task: Task = "exploration"

    def __init__(self, config: HabitsConfig, names: list[str]) -> None:
        self._fit, self._names = config, names
        shared = (each.name for each in fields(RunConfig) if hasattr(config, each.name))
        super().__init__(RunConfig(**{name: getattr(config, name) for name in shared}))

    def check_sources(self) -> None:
        """Check that the detector exists; the pictures are looked for when they are opened."""
        check_detector(self.config.detector.name)

    def open_scenes(self) -> Scenes:
        """The pictures that people saw."""
        return Pictures(self._fit.root, self._names, self.eye.detector.classes)

    def choices(self, number: int, records: list[Fixations], size: tuple[int, int]) -> Choices:
        """Gather the choices of all people in a picture.

        Shapes: size `(width, height)`.
        """
        if any((each.size, self.scenes.annotation(number).size) != (size, size) for each in records):
            raise DataError(
                f"{self._fit.fixations}: expected all pictures to have {size[0]} × {size[1]} pixels, got another "
                f"size for {records[0].picture}"
            )
        detections, grid = self.detections(number), self.grid(number)
        cells, count = fixated_cells(records, grid)
        values = {}
        for name in self.policies:
            candidate = self.candidate(name, number)
            acquire = partial(candidate.acquisition, None, grid)
            with torch.inference_mode():
                values[name] = values_in(StoredLooks(detections, grid), candidate.observer, acquire, cells, count)
        subject = torch.tensor([int(each.subject) for each in records])
        return replace(choices_in(cells, count, grid, number, subject), values=values)


_TERMS = {"policy": "policy", "centre": "centre bias", "steps": "saccade length", "return": "return"}


def _habits_report(halves: Halves, models: Sequence[FittedTerms], habits: GazeHabits) -> str:
    """Write the report as Markdown."""
    sizes = halves.sizes
    rows = [
        [
            model.policy or "none",
            " + ".join(_TERMS[term] for term in model.terms),
            f"{model.gain:+.3f} ± {model.error:.3f}",
            f"{model.even:.3f}",
            f"{model.fitted:.3f}",
        ]
        for model in models
    ]
    head = ["policy", "terms", "over the centre bias", "over a uniform choice", "over a uniform choice, fitted half"]
    steps = [f"up to {edge:g}" for edge in EDGES] + ["more"]
    ages = [f"{'' if low == high else f'{low:g} to '}{high:g}" for low, high in zip((1, 2, 3, 4), AGES, strict=True)]
    best = habits.metadata["policy"]
    return "\n".join(
        [
            "Information gain about people's next fixation, in bits per fixation (± standard error over pictures). "
            f"The models are fitted on {sizes['fitted_choices']} fixations of {sizes['fitted_people']} people in "
            f"{sizes['fitted_pictures']} pictures, and evaluated on {sizes['held_out_choices']} fixations of "
            f"{sizes['held_out_people']} other people in {sizes['held_out_pictures']} other pictures.",
            "",
            *table([head, *rows]),
            "",
            f"The model with all terms for the policy {best}: up to a constant, the log probability of a cell is the "
            f"sum of {float(habits.pull):.3f} times the policy's value (in standard deviations over the cells), the "
            "centre bias, and the following terms.",
            "",
            *table([["saccade length", *steps], ["steps", *(f"{v:+.2f}" for v in habits.step.tolist())]]),
            "",
            *table([["age in fixations", *ages, "more"], ["return", *(f"{v:+.2f}" for v in habits.back.tolist())]]),
            "",
            "Saccade lengths are in units of the image's longer side. The age of a cell is the number of fixations "
            "since it was last fixated.",
            "",
        ]
    )
