"""Draws scanpaths from the densities of a row, and compares them with people's as sequences of clusters."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from eval.human.viewing.density import (
    HABITS,
    DensityWeights,
    Habits,
    bins_of,
    blurred,
    enlarged,
    log_densities,
    standardised_maps,
)
from eval.human.viewing.rows import PEOPLE, Half, Scored
from semfov.belief.grid import Grid
from semfov.data.fixations import by_picture, read_table
from semfov.episode import rollout
from semfov.gaze.choice import Choice
from semfov.metrics.scanpath import cluster_labels, sequence_score
from semfov.runs.seeds import generator_for

_Array = NDArray[np.float64]


class DensityChoice(Choice):
    """Draws the next fixation from a density over the bins.

    Args:
        weights: weights of the density.
        habits: habits of people.
        raster: the bins.
        grid: the grid of looks.
        cells: the grid of the belief.
        start: `(B, 2)`, first fixations.
        generator: random generator of the draws.
    """

    def __init__(
        self,
        weights: DensityWeights,
        habits: Habits,
        raster: Grid,
        grid: Grid,
        cells: Grid,
        start: Tensor,
        generator: torch.Generator,
    ) -> None:
        self.weights, self.habits, self.raster, self.grid, self.cells = weights, habits, raster, grid, cells
        self.points, self.generator = [start], generator

    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Draw a bin; returns its centre, and the cell in which it lies."""
        points = self.draw(enlarged(values, self.cells, self.raster.rows, self.raster.columns))
        return points, self.cells.cell_of(points)

    def draw(self, maps: Tensor | None) -> Tensor:
        """Draw the next points `(B, 2)` from the row's maps `(B, H, W)` or `(1, H, W)` and the points so far."""
        height, width = self.habits.centre.shape
        last, count = self.points[-1], len(self.points[-1])
        visited = torch.zeros(count, len(self.grid))
        for points in self.points:
            visited.scatter_(1, self.grid.cell_of(points)[:, None], 1.0)
        terms = []
        for name in self.weights.terms:
            if name in HABITS:
                terms.append(self.habits.term(name, bins_of(self.raster, last), visited, self.grid))
            elif maps is not None:
                terms.append(standardised_maps(blurred(maps, self.weights.blur)).expand(count, -1, -1))
        flat = torch.zeros(count, height, width)
        density = log_densities(terms, self.weights.values).expand(count, -1, -1) if terms else flat
        bins = density.flatten(1).double().softmax(-1).multinomial(1, generator=self.generator)[:, 0]
        self.points.append(self.raster.centres.to(last)[bins])
        return self.points[-1]


def drawn_scanpaths(scored: Scored, half: Half, place: int) -> list[_Array]:
    """Draw one scanpath for each person of a picture, with the same first fixation and the same length."""
    run, index = half.run, half.pictures[place]
    people = run.people[str(run.scenes.ids[index])]
    lengths = [min(len(each), run.config.longest) for each in people]
    start = torch.stack([torch.from_numpy(each.points[0]) for each in people]).float()
    generator = generator_for("viewing", run.config.protocol.seed, run.scenes.ids[index], scored.row.name)
    raster, grid = run.raster(index), run.grid(index)
    name = scored.row.maps[0] if scored.row.maps else None
    if name is None or name in run.config.models:
        choice = DensityChoice(scored.weights, half.habits, raster, grid, raster, start, generator)
        maps = None if name is None else run.maps(name, index)
        for _ in range(max(lengths) - 1):
            choice.draw(maps)
    else:
        looks, candidate = run.looks(name, index), run.candidate(name, index)
        choice = DensityChoice(scored.weights, half.habits, raster, grid, looks.grid, start, generator)
        with torch.inference_mode():
            for _ in rollout(
                looks,
                candidate.observer,
                lambda _, cell: candidate.acquisition(None, looks.grid, cell),
                looks.grid.cell_of(start),
                choice,
                most=max(lengths) - 1,
            ):
                pass
    paths = torch.stack(choice.points, 1).double().numpy()
    return [path[:length] for path, length in zip(paths, lengths, strict=True)]


def score_sequences(scored: dict[tuple[str, str], Scored], half: Half) -> dict[str, _Array]:
    """Sequence scores of the rows that the settings name, of files and of people, as means over pairs of scanpaths.

    A drawn scanpath is compared with those of all people except the person whose first fixation it shares. A scanpath
    of a file is compared with those of all people. A file's row leaves out pictures that the file does not have.

    Args:
        scored: the scored rows by name and group.
        half: the half of the pictures for reporting.

    Returns:
        The scores of each row by picture.
    """
    run = half.run
    files = {path.stem: by_picture(read_table(path)) for path in run.config.files}
    chosen = [scored[key] for name in run.config.sequences for key in [_key(name, scored)] if key is not None]
    scores: dict[str, list[float]] = {name: [] for name in [*(each.row.name for each in chosen), *files, PEOPLE]}
    for place, index in enumerate(tqdm(half.pictures, desc="sequences", unit="picture")):
        people = [each.points[: run.config.longest] for each in run.people[str(run.scenes.ids[index])]]
        bandwidth = run.config.bandwidth * max(run.scenes.annotation(index).size)
        every = np.concatenate(people)
        words = _words(people, every, bandwidth)
        scores[PEOPLE].append(_beside(words, words))
        for each in chosen:
            drawn = _words(drawn_scanpaths(each, half, place), every, bandwidth)
            scores[each.row.name].append(_beside(drawn, words))
        for name, pictures in files.items():
            theirs = [each.points[: run.config.longest] for each in pictures.get(str(run.scenes.ids[index]), [])]
            if theirs:
                spelled = _words(theirs, every, bandwidth)
                scores[name].append(float(np.mean([sequence_score(a, b) for a in spelled for b in words])))
    return {name: np.array(values) for name, values in scores.items() if values}


def _key(name: str, scored: dict[tuple[str, str], Scored]) -> tuple[str, str] | None:
    return next((key for key in ((name, "with habits"), (name, "alone")) if key in scored), None)


def _words(paths: list[_Array], every: _Array, bandwidth: float) -> list[list[int]]:
    labels = cluster_labels(np.concatenate(paths), every, bandwidth).tolist()
    ends = np.cumsum([len(path) for path in paths]).tolist()
    return [labels[start:end] for start, end in zip([0, *ends], ends, strict=False)]


def _beside(ours: list[list[int]], theirs: list[list[int]]) -> float:
    pairs = [sequence_score(a, b) for i, a in enumerate(ours) for j, b in enumerate(theirs) if i != j]
    return float(np.mean(pairs))
