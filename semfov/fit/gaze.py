"""Fit where people look: a `FixationDensity` by maximum likelihood of fixations, over folds of pictures and people."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.data.fixations import Fixations
from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import FeatureMaps
from semfov.errors import check
from semfov.gaze.saliency.cells import cell_saliency
from semfov.gaze.saliency.fixation_density import FixationDensity, cells_of
from semfov.gaze.saliency.oculomotor import OculomotorBias

LONGEST = 20
"""Number of fixations of a scanpath that are used, the first ones."""

_EVENTS = 20
"""Fixations of a picture in a pass of the fit of oculomotor biases."""


@dataclass(frozen=True)
class Viewed:
    """Pictures of one size with their feature maps, and the scanpaths of all people in them.

    Shapes: maps `(P, C, h, w)` in half precision; paths one list for each picture, of `(n, 2)` in pixels of it.
    """

    features: FeatureMaps
    paths: tuple[tuple[Tensor, ...], ...]
    durations: tuple[tuple[Tensor, ...], ...] = ()
    seconds: float = 3.0

    @property
    def size(self) -> tuple[int, int]:
        """`(height, width)` of the pictures."""
        return self.features.placement.size[1], self.features.placement.size[0]

    def __len__(self) -> int:
        return len(self.paths)

    def some(self, pictures: Sequence[int]) -> FeatureMaps:
        """The feature maps of some pictures, in single precision."""
        place = torch.as_tensor(pictures)
        return replace(self.features, maps={name: each[place].float() for name, each in self.features.maps.items()})

    def counts(self, people: Callable[[int], bool] | None = None) -> Tensor:
        """Numbers of fixations, without the first of each path, in the cells of each picture, `(P, rows, columns)`."""
        rows, columns = cells_of(self.size)
        counts = torch.zeros(len(self), rows * columns)
        for row, paths in zip(counts, self.paths, strict=True):
            for person, path in enumerate(paths):
                if people is None or people(person):
                    cells = _cells(path[1:], self.size, (rows, columns))
                    row.index_add_(0, cells, torch.ones(len(cells)))
        return counts.unflatten(1, (rows, columns))


def _cells(points: Tensor, size: tuple[int, int], cells: tuple[int, int]) -> Tensor:
    """Numbers of the cells that hold points; those outside the picture belong to the nearest cell."""
    x = ((points[:, 0] + 0.5) * (cells[1] / size[1])).floor().clamp(0, cells[1] - 1)
    y = ((points[:, 1] + 0.5) * (cells[0] / size[0])).floor().clamp(0, cells[0] - 1)
    return (y * cells[1] + x).long()


def viewed(
    detector: Detector,
    images: Iterable[tuple[Tensor, Sequence[Fixations]]],
    layers: Sequence[str] | None,
    seconds: float = 3.0,
) -> list[Viewed]:
    """Look at pictures `(3, H, W)` once, and keep feature maps and scanpaths, by the size of the pictures."""
    kept: dict[Any, list[tuple[FeatureMaps, list[Fixations]]]] = {}
    with torch.inference_mode():
        for image, people in images:
            features = detector.features(image[None], layers)
            half = {name: each.half() for name, each in features.maps.items()}
            size = features.placement.size
            moved = [each.resized(size) for each in people if len(each) > 1]
            kept.setdefault((features.placement, features.canvas), []).append((replace(features, maps=half), moved))
    groups = []
    for several in kept.values():
        first = several[0][0]
        maps = {name: torch.cat([features.maps[name] for features, _ in several]) for name in first.maps}
        paths = tuple(tuple(torch.from_numpy(p.points[:LONGEST]).float() for p in each) for _, each in several)
        times = tuple(
            tuple(torch.from_numpy(p.durations[:LONGEST]).float() for p in each if p.durations is not None)
            for _, each in several
        )
        nothing = Detections(torch.zeros(0, 0, 4), torch.zeros(0, 0, 1), torch.zeros(0, 0, dtype=torch.bool))
        groups.append(Viewed(replace(first, maps=maps, detections=nothing), paths, times, seconds))
    return groups


def log_centre(counts: Sequence[Tensor], *, blur: float = 2.5, floor: float = 0.02) -> Tensor:
    """Log density of all fixations of data sets, all alike, blurred and mixed with a uniform one, on 39 × 52 cells."""
    total = torch.zeros(39, 52)
    for each in counts:
        smooth = _blurred(F.interpolate(each.sum(0)[None, None], total.shape, mode="bilinear")[0, 0], blur)
        total += smooth / smooth.sum() / len(counts)
    return ((1 - floor) * total + floor / total.numel()).log()


def _blurred(counts: Tensor, sigma: float) -> Tensor:
    for axis in (0, 1):
        place = torch.arange(counts.shape[axis], dtype=counts.dtype)
        weights = (-(place[:, None] - place).square() / (2 * sigma**2)).softmax(-1)
        counts = (weights @ counts if axis == 0 else counts @ weights.mT) if counts.numel() else counts
    return counts


def fit_map(
    model: FixationDensity,
    groups: Sequence[Viewed],
    counts: Sequence[Tensor],
    pictures: Sequence[Sequence[int]],
    *,
    epochs: int = 12,
    batch: int = 8,
    rate: float = 3e-3,
    decay: float = 0.01,
    dropout: float = 0.2,
    seed: int = 0,
    done: Callable[[int, float], None] = lambda epoch, loss: None,
) -> None:
    """Fit map and weight of the centre bias to the counts of some pictures of each group, every picture alike.

    Each readout has its own likelihood, and reads only a random part of the channels in each step.
    """
    generator = torch.Generator().manual_seed(seed)
    scale = _standardise(model, groups, pictures)
    weights = [model.read, model.mix, model.out]
    others = [model.shift, model.mix_shift, model.blur, model.centre_weight]
    optimiser = torch.optim.AdamW(
        [{"params": weights, "weight_decay": decay}, {"params": others, "weight_decay": 0.0}], lr=rate
    )
    steps = sum(-(-len(some) // batch) for some in pictures) * epochs
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=max(steps, 2), pct_start=0.1)
    parts = model.out.shape[0]
    model.train()
    for epoch in range(epochs):
        total, number = 0.0, 0
        for group, some in _batches(pictures, batch, generator):
            kept = torch.rand(parts, 1, model.read.shape[1], generator=generator) >= dropout
            mask = (kept / (1 - dropout)).expand(-1, model.out.shape[1], -1).flatten(0, 1) / scale
            size = groups[group].size
            values = model.readouts(groups[group].some(some), size, model.read * mask)
            values = values + model.centre_bias(size)
            log = values - values.flatten(2).logsumexp(2)[..., None, None]
            seen = counts[group][torch.as_tensor(some)]
            likelihood = (log * seen[:, None]).sum((2, 3)).mean(1) / seen.sum((1, 2)).clamp(min=1)
            optimiser.zero_grad()
            (-likelihood.mean()).backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
            optimiser.step()
            schedule.step()
            total, number = total - float(likelihood.detach().mean()), number + 1
        done(epoch, total / max(number, 1))
    with torch.no_grad():
        model.read.div_(scale)
    model.eval()


def _standardise(model: FixationDensity, groups: Sequence[Viewed], pictures: Sequence[Sequence[int]]) -> Tensor:
    """Standard deviations of all channels; the readouts begin with the mean of each channel at 0."""
    means, deviations = [], []
    for name in model.layers:
        some = [
            group.features.maps[name][torch.as_tensor(which[:: max(1, len(which) // 60)])].float()
            for group, which in zip(groups, pictures, strict=True)
            if len(which)
        ]
        flat = torch.cat([each.transpose(0, 1).flatten(1) for each in some], 1)
        means.append(flat.mean(1))
        deviations.append(flat.std(1).clamp(min=1e-3))
    scale = torch.cat(deviations)
    with torch.no_grad():
        model.shift.sub_((model.read / scale) @ torch.cat(means))
    return scale


def _batches(
    pictures: Sequence[Sequence[int]], batch: int, generator: torch.Generator
) -> Iterator[tuple[int, list[int]]]:
    """Random batches of pictures of the same group, in random order."""
    batches = []
    for group, some in enumerate(pictures):
        order = [some[int(place)] for place in torch.randperm(len(some), generator=generator)]
        batches += [(group, order[start : start + batch]) for start in range(0, len(order), batch)]
    for place in torch.randperm(len(batches), generator=generator).tolist():
        yield batches[place]


@torch.no_grad()
def maps_of(model: FixationDensity, group: Viewed, pictures: Sequence[int], batch: int = 16) -> Tensor:
    """The map of pictures `(P, rows, columns)`."""
    parts = [pictures[start : start + batch] for start in range(0, len(pictures), batch)]
    return torch.cat([model.map(group.some(part), group.size) for part in parts])


class Events(NamedTuple):
    """Fixations to be predicted in a picture, all but the first of each path: fixations before, cell and person.

    Shapes: before `(E, N, 2)`, NaN before a shorter path; cell `(E,)`; person `(E,)`.
    """

    before: Tensor
    cell: Tensor
    person: Tensor

    def some(self, index: Tensor) -> Events:
        """Some of the events."""
        return Events(self.before[index], self.cell[index], self.person[index])


def events_of(paths: Sequence[Tensor], size: tuple[int, int], cells: tuple[int, int]) -> Events:
    """The events of a picture of `(height, width)` with cells `(rows, columns)`."""
    before, cell, person = [], [], []
    for number, path in enumerate(paths):
        for_each = range(1, len(path))
        before += [F.pad(path[:last].t(), (LONGEST - 1 - last, 0), value=math.nan).t() for last in for_each]
        cell.append(_cells(path[1:], size, cells))
        person.append(torch.full((len(path) - 1,), number))
    return Events(torch.stack(before), torch.cat(cell), torch.cat(person))


def fit_oculomotor(
    model: FixationDensity,
    groups: Sequence[Viewed],
    maps: Sequence[Tensor],
    pictures: Sequence[Sequence[int]],
    *,
    epochs: int = 10,
    batch: int = 8,
    rate: float = 0.03,
    people: Callable[[int], bool] | None = None,
    seed: int = 0,
    done: Callable[[int, float], None] = lambda epoch, loss: None,
) -> None:
    """Fit oculomotor biases and gains to the next fixations, given the maps `(P, rows, columns)` of these pictures."""
    generator = torch.Generator().manual_seed(seed)
    model.oculomotor = OculomotorBias()
    optimiser = torch.optim.AdamW(model.oculomotor.parameters(), lr=rate, weight_decay=1e-3)
    steps = sum(-(-len(some) // batch) for some in pictures) * epochs
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=max(steps, 2), pct_start=0.2)
    places = [{picture: row for row, picture in enumerate(some)} for some in pictures]
    events = [
        {
            picture: _of_people(events_of(group.paths[picture], group.size, cells_of(group.size)), people)
            for picture in some
        }
        for group, some in zip(groups, pictures, strict=True)
    ]
    for epoch in range(epochs):
        total, number = 0.0, 0
        for group, some in _batches(pictures, batch, generator):
            size = groups[group].size
            centre = model.centre_bias(size).detach()
            losses = []
            for picture in some:
                chosen, corner = _drawn(events[group][picture], size, generator)
                if not len(chosen.cell):
                    continue
                terms = {"map": maps[group][places[group][picture]][None], "centre bias": centre[None]}
                log = torch.stack([*model.given(terms, size, chosen.before, corner).values()]).sum(0)
                rows, columns = chosen.cell // cells_of(size)[1], chosen.cell % cells_of(size)[1]
                target = rows // corner[2] * log.shape[-1] + columns // corner[2]
                losses.append(F.cross_entropy(log.flatten(1), target))
            if not losses:
                continue
            optimiser.zero_grad()
            loss = torch.stack(losses).mean()
            loss.backward()
            optimiser.step()
            schedule.step()
            total, number = total + float(loss.detach()), number + 1
        done(epoch, total / max(number, 1))


def _of_people(events: Events, people: Callable[[int], bool] | None) -> Events:
    """The events of some people; None for all."""
    if people is None:
        return events
    return events.some(torch.tensor([people(int(person)) for person in events.person]).bool())


def _drawn(events: Events, size: tuple[int, int], generator: torch.Generator) -> tuple[Events, tuple[int, int, int]]:
    """Random events on every second row and column of cells, and the first of these: a quarter of the computation.

    The likelihood of a fixation given that it is on these cells has the same parameters.
    """
    top, left = (int(each) for each in torch.randint(2, (2,), generator=generator))
    rows, columns = events.cell // cells_of(size)[1], events.cell % cells_of(size)[1]
    there = ((rows % 2 == top) & (columns % 2 == left)).nonzero()[:, 0]
    chosen = events.some(there[torch.randperm(len(there), generator=generator)[:_EVENTS]])
    longest = int((~chosen.before[..., 0].isnan()).sum(1).max()) if len(there) else 1
    return Events(chosen.before[:, -longest:], chosen.cell, chosen.person), (top, left, 2)


def describe_viewing(model: FixationDensity, groups: Sequence[Viewed]) -> None:
    """Set first fixations, durations and pauses of a model to those of all people."""
    firsts, sums, counts = [], [], []
    logs: list[list[Tensor]] = [[] for _ in range(5)]
    for group in groups:
        height, width = group.size
        for paths, times in zip(group.paths, group.durations, strict=True):
            firsts += [(path[0] + 0.5) / torch.tensor([width, height]) for path in paths]
            for each in times:
                for number, one in enumerate(each.clamp(min=1).log()):
                    logs[min(number, 4)].append(one)
                sums.append((1000 * group.seconds - each.sum()) if len(each) < LONGEST else None)
                counts.append(len(each))
    first = torch.stack(firsts)
    model.start = torch.stack([first.mean(0), first.std(0)])
    known = [(left, count) for left, count in zip(sums, counts, strict=True) if left is not None]
    if known:
        model.duration = torch.stack([torch.stack([torch.stack(x).mean(), torch.stack(x).std()]) for x in logs if x])
        model.pause = torch.stack([left / count for left, count in known]).mean().clamp(min=0)


MEASURES = ("NSS", "AUC", "log likelihood")


@torch.no_grad()
def score(
    model: FixationDensity,
    group: Viewed,
    maps: Tensor,
    pictures: Sequence[int],
    *,
    conditional: bool,
    without: Sequence[str] = (),
    people: Callable[[int], bool] | None = None,
    raster: tuple[int, int] = (40, 30),
) -> Tensor:
    """NSS, AUC and log likelihood in bits above uniform of the fixations of pictures, means of each `(P, 3)`.

    Densities are sums over the bins of a raster of `(columns, rows)`; fixations are all but the first of each path.
    """
    size = group.size
    rows = []
    terms = {"centre bias": model.centre_bias(size)[None]}
    for one, picture in zip(maps, pictures, strict=True):
        events = _of_people(events_of(group.paths[picture], size, raster[::-1]), people)
        alone = {**terms, "map": one[None]}
        given = model.given(alone, size, events.before) if conditional else alone
        log = sum((term for name, term in given.items() if name not in without), torch.zeros(1, 1, 1))
        if log.numel() == 1:
            log = torch.zeros_like(one)[None]
        density = cell_saliency((log - log.flatten(1).logsumexp(1)[:, None, None]).exp(), *raster)
        density = (density / density.sum(1, keepdim=True)).expand(len(events.cell), -1)
        rows.append(_scores(density, events.cell))
    return torch.stack(rows)


@torch.no_grad()
def people_score(
    group: Viewed, pictures: Sequence[int], centre: Tensor, *, blur: float = 1.0, share: float = 0.05
) -> Tensor:
    """Inter-observer scores `(P, 3)` as of `score`: each person by the fixations of all others in the picture.

    Their counts in 40 × 30 bins without first fixations are blurred by `blur` bins, and mixed with a `share` of the
    centre bias, a log density `(rows, columns)`.
    """
    shape = (30, 40)
    bias = F.interpolate(centre[None, None], shape, mode="bilinear")[0, 0].flatten().softmax(0)
    rows = []
    for picture in pictures:
        events = events_of(group.paths[picture], group.size, shape)
        counts = torch.zeros(len(group.paths[picture]), shape[0] * shape[1])
        counts.index_put_((events.person, events.cell), torch.ones(len(events.cell)), accumulate=True)
        others = (counts.sum(0) - counts).unflatten(1, shape)
        smooth = torch.stack([_blurred(each, blur) for each in others]).flatten(1)
        density = (1 - share) * smooth / smooth.sum(1, keepdim=True) + share * bias
        rows.append(_scores(density[events.person], events.cell))
    return torch.stack(rows)


def _scores(density: Tensor, cell: Tensor) -> Tensor:
    """Means of NSS, AUC and log likelihood in bits above uniform of fixations in cells of densities `(E, N)`."""
    at = density.gather(1, cell[:, None])[:, 0]
    z = (at - density.mean(1)) / density.std(1, unbiased=False).clamp(min=1e-12)
    below = (density < at[:, None]).float().mean(1) + (density == at[:, None]).float().mean(1) / 2
    return torch.stack([z.mean(), below.mean(), (at * density.shape[1]).log2().mean()])


def folds(number: int, count: int, fold: int) -> tuple[list[int], list[int]]:
    """Pictures to fit on and pictures held out of one of `count` folds: every `count`-th picture is held out."""
    check(0 <= fold < count, "fold", f"a number from 0 to {count - 1}", fold)
    held = [*range(fold, number, count)]
    return [each for each in range(number) if each not in set(held)], held


def summary_of(metrics: Tensor, baseline: Tensor) -> Mapping[str, float]:
    """Means over pictures of NSS, AUC and information gain over a baseline, `(P, 3)` each."""
    gain = metrics[:, 2] - baseline[:, 2]
    return {"NSS": float(metrics[:, 0].mean()), "AUC": float(metrics[:, 1].mean()), "gain": float(gain.mean())}
