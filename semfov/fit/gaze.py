"""Fit where people look: a `FixationDensity` by maximum likelihood of fixations, and its scores on other fixations."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.training import descend
from semfov.fit.viewing import Events, Viewed, log_centre
from semfov.gaze.saliency import OculomotorBias, cell_saliency
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of
from semfov.runs.settings import Count, Positive, Range, Seed, Settings, Share, Whole

_EVENTS = 12  # fixations of a picture in a pass of the fit of oculomotor biases
_SCORED = 40  # fixations of a picture on which conditional densities are scored, drawn at random

_MapsOfPicture = Tensor | Callable[[Events], Tensor]
"""Map of a picture, `(1, rows, columns)`, one for each person, or what gives one for each event."""
_Pictures = Sequence[Sequence[int]]  # pictures of each group


@dataclass(frozen=True)
class GazeFit(Settings):
    """How a model of where people look is fitted.

    Args:
        readouts: number of readouts whose mean is the map.
        units: number of channels of a readout.
        epochs: passes over the pictures in the fit of the map.
        saccade_epochs: passes over the pictures in the fit of the oculomotor biases (0: they stay 0).
        batch: pictures in a step.
        rate: highest learning rate.
        decay: weight decay.
        dropout: share of the channels that a readout leaves out in a step.
        seed: seed of the fit.
    """

    readouts: Annotated[int, Range(1, 16)] = 4
    units: Annotated[int, Range(1, 256)] = 32
    epochs: Count = 20
    saccade_epochs: Whole = 3
    batch: Count = 8
    rate: Positive = 3e-3
    decay: Positive = 0.3
    dropout: Share = 0.2
    seed: Seed = 0


def fitted_density(fit: GazeFit, groups: Sequence[Viewed], pictures: _Pictures, title: str) -> FixationDensity:
    """Fit a model to some pictures of each group, with progress bars."""
    torch.manual_seed(fit.seed)
    channels = {name: each.shape[1] for name, each in groups[0].features.maps.items()}
    centre = log_centre(groups, pictures)
    model = FixationDensity(channels, readouts=fit.readouts, units=fit.units, centre=centre)
    _fit_map(model, groups, pictures, fit, f"map, {title}")
    maps = [maps_of(model, group, some) for group, some in zip(groups, pictures, strict=True)]
    fit_oculomotor(model, groups, maps, pictures, fit, title=f"saccades, {title}")
    return model.requires_grad_(False)


def _fit_map(
    model: FixationDensity, groups: Sequence[Viewed], pictures: _Pictures, fit: GazeFit, title: str = "map"
) -> None:
    """Fit map and weight of the centre bias to fixations; each readout has its likelihood and reads random channels."""
    generator = torch.Generator().manual_seed(fit.seed)
    scale, batches = _standardise(model, groups, pictures), _batches(pictures, fit.batch, generator)
    parts = model.out.shape[0]

    def loss_of(_: int) -> Tensor:
        number, some = next(batches)
        group = groups[number]
        kept = torch.rand(parts, 1, model.read.shape[1], generator=generator) >= fit.dropout
        mask = (kept / (1 - fit.dropout)).expand(-1, model.out.shape[1], -1).flatten(0, 1) / scale
        values = blurred(model.readouts(group.some(some), group.size, model.read * mask), model.blur.exp())
        values = values + model.centre_bias(group.size)
        log = values - values.flatten(2).logsumexp(2)[..., None, None]
        seen = group.counts[torch.as_tensor(some)]
        # All pictures count alike.
        return -((log * seen[:, None]).sum((2, 3)).mean(1) / seen.sum((1, 2)).clamp(min=1)).mean()

    # Only weights of channels decay.
    own = [
        {"params": each, "weight_decay": fit.decay * (name in ("read", "mix", "out"))}
        for name, each in model.named_parameters()
    ]
    model.train()
    descend(own, loss_of, fit.epochs * _steps(pictures, fit.batch), fit.rate, clip=5.0, rise=0.1, title=title)
    with torch.no_grad():
        model.read.div_(scale)
    model.eval()


def _steps(pictures: _Pictures, batch: int) -> int:
    """Number of batches of pictures in an epoch."""
    return sum(-(-len(some) // batch) for some in pictures)


def _batches(pictures: _Pictures, batch: int, generator: torch.Generator) -> Iterator[tuple[int, list[int]]]:
    """Random batches of pictures of one group, with its number, in random order, epoch after epoch."""
    while True:
        batches = list[tuple[int, list[int]]]()
        for group, some in enumerate(pictures):
            order = [some[int(place)] for place in torch.randperm(len(some), generator=generator)]
            batches += [(group, order[start : start + batch]) for start in range(0, len(order), batch)]
        yield from (batches[place] for place in torch.randperm(len(batches), generator=generator).tolist())


def _standardise(model: FixationDensity, groups: Sequence[Viewed], pictures: _Pictures) -> Tensor:
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


@torch.no_grad()
def maps_of(model: FixationDensity, group: Viewed, pictures: Sequence[int], batch: int = 16) -> list[Tensor]:
    """The map of each picture, `(1, rows, columns)`."""
    parts = [pictures[start : start + batch] for start in range(0, len(pictures), batch)]
    return [each[None] for part in parts for each in model.map(group.some(part), group.size)]


def fit_oculomotor(
    model: FixationDensity,
    groups: Sequence[Viewed],
    maps: Sequence[Sequence[Tensor]],
    pictures: _Pictures,
    fit: GazeFit,
    *,
    rate: float = 0.03,
    title: str = "saccades",
) -> None:
    """Fit oculomotor biases and gains to the next fixations; maps `(1, rows, columns)`, or one for each person."""
    generator = torch.Generator().manual_seed(fit.seed)
    model.oculomotor = OculomotorBias()
    places = [{picture: row for row, picture in enumerate(some)} for some in pictures]
    events = [
        {picture: Events.of(group.paths[picture], group.size, cells_of(group.size)) for picture in some}
        for group, some in zip(groups, pictures, strict=True)
    ]

    batches = _batches(pictures, fit.batch, generator)

    def loss_of(_: int) -> Tensor | None:
        number, some = next(batches)
        size = groups[number].size
        centre = model.centre_bias(size).detach()
        losses = []
        for picture in some:
            # Random events on every second row and column of cells: a quarter of the computation. The likelihood of
            # a fixation given that it is on these cells has the same parameters.
            every = events[number][picture]
            top, left = (int(each) for each in torch.randint(2, (2,), generator=generator))
            rows, columns = every.cell // cells_of(size)[1], every.cell % cells_of(size)[1]
            there = ((rows % 2 == top) & (columns % 2 == left)).nonzero()[:, 0]
            chosen = every.some(there[torch.randperm(len(there), generator=generator)[:_EVENTS]])
            if not len(chosen.cell):
                continue
            longest = int((~chosen.before[..., 0].isnan()).sum(1).max())
            chosen, corner = chosen._replace(before=chosen.before[:, -longest:]), (top, left, 2)
            terms = {"map": _for_events(maps[number][places[number][picture]], chosen), "centre bias": centre[None]}
            log = torch.stack([*model.given(terms, size, chosen.before, corner).values()]).sum(0)
            rows, columns = chosen.cell // cells_of(size)[1], chosen.cell % cells_of(size)[1]
            target = rows // corner[2] * log.shape[-1] + columns // corner[2]
            losses.append(F.cross_entropy(log.flatten(1), target))
        return torch.stack(losses).mean() if losses else None

    steps, own = fit.saccade_epochs * _steps(pictures, fit.batch), model.oculomotor.parameters()
    descend(own, loss_of, steps, rate, clip=None, decay=1e-3, rise=0.2, title=title)


def _for_events(maps: _MapsOfPicture, events: Events) -> Tensor:
    """The map of each event."""
    if not isinstance(maps, Tensor):
        return maps(events)
    return maps if len(maps) == 1 else maps[events.person]


@torch.no_grad()
def score(
    model: FixationDensity,
    group: Viewed,
    maps: Sequence[_MapsOfPicture],
    pictures: Sequence[int],
    *,
    conditional: bool,
    without: Sequence[Sequence[str]] = ((),),
    raster: tuple[int, int] = (40, 30),
) -> list[Tensor]:
    """NSS, AUC and log likelihood in bits above uniform of the fixations of pictures, means of each `(P, 3)`.

    One result for each set of terms to leave out. Densities are sums over the bins of a raster of `(columns, rows)`;
    fixations are all but the first of each path, and of these some where the scanpath is given.
    """
    size, generator = group.size, torch.Generator().manual_seed(0)
    rows: list[list[Tensor]] = [[] for _ in without]
    terms = {"centre bias": model.centre_bias(size)[None]}
    for one, picture in zip(maps, pictures, strict=True):
        events = Events.of(group.paths[picture], size, raster[::-1])
        if conditional:
            events = events.some(torch.randperm(len(events.cell), generator=generator)[:_SCORED])
        given: dict[str, Tensor] = {**terms, "map": _for_events(one, events)}
        given = model.given(given, size, events.before) if conditional else given
        for left_out, scored in zip(without, rows, strict=True):
            kept = [term for name, term in given.items() if name not in left_out]
            log = sum(kept, torch.zeros_like(given["map"][:1]))
            density = cell_saliency((log - log.flatten(1).logsumexp(1)[:, None, None]).exp(), *raster)
            density = (density / density.sum(1, keepdim=True)).expand(len(events.cell), -1)
            scored.append(_scores(density, events.cell))
    return [torch.stack(scored) if scored else torch.zeros(0, 3) for scored in rows]


def _scores(density: Tensor, cell: Tensor) -> Tensor:
    """Means of NSS, AUC and log likelihood in bits above uniform of fixations in cells of densities `(E, N)`."""
    at = density.gather(1, cell[:, None])[:, 0]
    z = (at - density.mean(1)) / density.std(1, unbiased=False).clamp(min=1e-12)
    below = (density < at[:, None]).float().mean(1) + (density == at[:, None]).float().mean(1) / 2
    return torch.stack([z.mean(), below.mean(), (at * density.shape[1]).log2().mean()])
