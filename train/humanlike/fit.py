"""Fit a model of how people choose their next fixation, and evaluate it on other people and pictures."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, by_picture, read_osie
from semfov.data.pictures import Pictures
from semfov.episode import StoredLooks
from semfov.errors import DataError, check, lookup
from semfov.eye import Eye
from semfov.fit.outputs import model_path, write_outputs
from semfov.fit.settings import NameConfig
from semfov.runs.candidates import Candidate, load_models, make_strategy
from semfov.runs.config import (
    BeliefConfig,
    OutcomeConfig,
    PolicyConfig,
    RunConfig,
    SaliencyConfig,
    SensorConfig,
)
from semfov.runs.presets import label, resolve
from semfov.runs.remembered import look_everywhere
from semfov.runs.saliency_store import saliency_table
from semfov.runs.scene_run import store_folder
from semfov.runs.settings import Count, Positive
from semfov.runs.setup import make_eye, prepare_worker
from semfov.runs.store import cell_store
from train.humanlike.habits import Halves, fit_terms, habits_of
from train.humanlike.report import humanlike_report
from train.humanlike.viewings import Choices, choices_in, fixated_cells, values_in


@dataclass(frozen=True)
class FitHumanlikeConfig(NameConfig, OutcomeConfig):
    """Fit a model of how people choose their next fixation.

    Args:
        root: folder of the pictures.
        fixations: JSON file of people's fixations in the pictures, in OSIE's format
            (`semfov.data.fixations.write_osie`).
        detector: the detector that processes the foveated views.
        sensor: the foveal sensor.
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

    root: Path = field(kw_only=True)
    fixations: Path = field(kw_only=True)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    saliency: SaliencyConfig = field(default_factory=lambda: SaliencyConfig(view="picture", reduction="mean"))
    policies: tuple[str | PolicyConfig, ...] = ("kl-raw", "closer-look-raw", "vocus2-raw", "itti-koch-raw")
    save: str | None = None
    limit: Count | None = None
    ridge: Positive = 1.0
    smoothing: Positive = 1.0
    out: Path = Path("runs/fit_humanlike")


def fit_humanlike(config: FitHumanlikeConfig) -> None:
    """Gather people's choices, fit half of the people on half of the pictures, and evaluate on the others."""
    check(len(config.policies) > 0, "policies", "at least one policy", "none")
    prepare_worker()
    names = [label(choice, "exploration") for choice in config.policies]
    if config.save is not None:
        lookup(config.save, names, "policy to save")
    choices, size, eye = gather_choices(config)
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
    text = humanlike_report(halves, [model for several in models.values() for model in several], habits)
    figures = [model.figures() for several in models.values() for model in several]
    write_outputs(config, text, ("bits.json", json.dumps(figures, indent=2) + "\n"), path)


def gather_choices(config: FitHumanlikeConfig) -> tuple[Choices, tuple[int, int], Eye]:
    """Gather people's choices with the value that every policy gives to each cell.

    Args:
        config: the settings.

    Returns:
        All choices, the size `(width, height)` of the pictures, and the eye.

    Raises:
        DataError: pictures are missing, or their size differs from that in the file of fixations.
    """
    people = by_picture(read_osie(config.fixations))
    viewer = Viewer(config, list(people)[: config.limit])
    size = people[str(viewer.pictures.ids[0])][0].size
    found = []
    for number, name in enumerate(tqdm(viewer.pictures.ids, desc="looking as people did", unit="picture")):
        found.append(viewer.choices(number, people[str(name)], size))
    return Choices.join(found), size, viewer.eye


class Viewer:
    """Compute the values that policies give to the cells of pictures whenever a person chose the next fixation.

    Args:
        config: settings of the fit.
        names: file names of the pictures.
    """

    def __init__(self, config: FitHumanlikeConfig, names: list[str]) -> None:
        self.config = config
        self.eye = make_eye(config.detector, config.sensor)
        self.pictures = Pictures(config.root, names, self.eye.detector.classes)
        policies = config.policies
        run = RunConfig(detector=config.detector, sensor=config.sensor, belief=config.belief, policies=policies)
        models, components = load_models(run, "exploration", self.eye), len(self.pictures.classes) + 1
        self.policies = {label(choice, "exploration"): resolve(choice, "exploration") for choice in policies}
        self.strategies = {
            name: make_strategy(policy, "exploration", config.belief, components, models, config.sensor.fovea)
            for name, policy in self.policies.items()
        }
        size = config.belief.columns, config.belief.rows
        self.store = cell_store(store_folder(config.cache) / "looks", self.eye.settings(), *size, components)

    def choices(self, number: int, records: list[Fixations], size: tuple[int, int]) -> Choices:
        """Gather the choices of all people in a picture.

        Args:
            number: number of the picture.
            records: people's fixations in it.
            size: `(width, height)` that all pictures should have.

        Returns:
            The choices with the values of all policies.

        Raises:
            DataError: the picture or its fixations have another size.
        """
        image, digest = self.pictures[number].image, self.pictures.digest(number)
        if any((each.size, (image.shape[-1], image.shape[-2])) != (size, size) for each in records):
            raise DataError(
                f"{self.config.fixations}: expected all pictures to have {size[0]} × {size[1]} pixels, got another "
                f"size for {records[0].picture}"
            )
        grid = Grid(self.config.belief.columns, self.config.belief.rows, size)
        seen = look_everywhere(self.eye, lambda: image[None], grid, self.store, lambda: digest)
        cells, count = fixated_cells(records, grid)
        values = {}
        for name in self.policies:
            candidate = self.candidate(name, image, grid)
            acquire = partial(candidate.acquisition, None, grid)
            with torch.inference_mode():
                values[name] = values_in(StoredLooks(seen, grid), candidate.observer, acquire, cells, count)
        subject = torch.tensor([int(each.subject) for each in records])
        return replace(choices_in(cells, count, grid, number, subject), values=values)

    def candidate(self, name: str, image: Tensor, grid: Grid) -> Candidate:
        """Prepare a policy for a picture."""
        policy, saliency = self.policies[name], self.config.saliency
        strategy = self.strategies[name]
        if policy.saliency is None:
            return Candidate(strategy)
        maps = saliency_table(policy.saliency, saliency, self.eye.sensor, self.config.sensor.reference, image, grid)
        if strategy.policy.table == "saliency":
            return Candidate(strategy, maps)
        return Candidate(strategy, saliency=maps, weight=saliency.weight)
