"""Fit where people look: a `FixationDensity` by maximum likelihood of fixations, and its scores on other fixations."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.training import descend
from semfov.gaze.saliency import OculomotorBias, cell_saliency
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of
from semfov.human.viewing import Events, Viewed, log_centre
from semfov.io.ranges import Count, Positive, Range, Seed, Share, Whole
from semfov.runs.settings import Settings

_EVENTS = 12  # fixations of a picture in a pass of the fit of oculomotor biases
_SCORED = 40  # fixations of a picture on which conditional densities are scored, drawn at random
_STANDARDISED = 60  # pictures of a group from which the means of channels are taken, about
_EVERY = 2  # the fit of oculomotor biases computes every second row and column of cells

_MapsOfPicture = Tensor | Callable[[Events], Tensor]
"""Map of a picture, `(1, rows, columns)`, one for each person, or what gives one for each event."""
_Pictures = Sequence[Sequence[int]]  # pictures of each group


@dataclass(frozen=True)
class GazeFit(Settings):
    """Settings of the fit of a model of where people look.

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
    """Fit a model to some pictures of each group, with progress bars.

    Args:
        fit: settings of the fit.
        groups: pictures of one size each, with everybody's scanpaths.
        pictures: numbers of the pictures of each group to fit to.
        title: what is fitted to, for the progress bars.

    Returns:
        The model, whose parameters need no gradient.
    """
    torch.manual_seed(fit.seed)
    channels = {name: maps.shape[1] for name, maps in groups[0].features.maps.items()}
    centre = log_centre(groups, pictures)
    model = FixationDensity(channels, readouts=fit.readouts, units=fit.units, centre=centre)
    _fit_map(model, groups, pictures, fit, f"map, {title}")
    maps = [maps_of(model, group, numbers) for group, numbers in zip(groups, pictures, strict=True)]
    fit_oculomotor(model, groups, maps, pictures, fit, title=f"saccades, {title}")
    return model.requires_grad_(False)


def _fit_map(
    model: FixationDensity,
    groups: Sequence[Viewed],
    pictures: _Pictures,
    fit: GazeFit,
    title: str = "map",
) -> None:
    """Fit map and weight of the centre bias to fixations; each readout has its likelihood and reads random channels."""
    generator = torch.Generator().manual_seed(fit.seed)
    scale = _standardise(model, groups, pictures)
    batches = _batches(pictures, fit.batch, generator)
    readouts, units = model.out.shape[:2]

    def loss_of(_: int) -> Tensor:
        number, batch = next(batches)
        group = groups[number]
        # Whole channels are left out, other ones for each readout.
        is_read = torch.rand(readouts, 1, model.read.shape[1], generator=generator) >= fit.dropout
        # Raised, so that in the mean as much is read as later, when no channel is left out.
        mask = (is_read / (1 - fit.dropout)).expand(-1, units, -1).flatten(0, 1) / scale
        maps = blurred(model.readouts(group.some(batch), group.size, model.read * mask), model.blur.exp())
        values = maps + model.centre_bias(group.size)
        log_density = values - values.flatten(2).logsumexp(2)[..., None, None]
        counts = group.counts[torch.as_tensor(batch)]
        # All pictures count alike.
        likelihood = (log_density * counts[:, None]).sum((2, 3)).mean(1) / counts.sum((1, 2)).clamp(min=1)
        return -likelihood.mean()

    # Only weights of channels decay.
    parameters = [
        {"params": parameter, "weight_decay": fit.decay * (name in ("read", "mix", "out"))}
        for name, parameter in model.named_parameters()
    ]
    model.train()
    steps = fit.epochs * _steps(pictures, fit.batch)
    descend(parameters, loss_of, steps, fit.rate, clip=5.0, rise=0.1, title=title)
    with torch.no_grad():
        # From now on the model reads channels as they are.
        model.read.div_(scale)
    model.eval()


def _steps(pictures: _Pictures, batch: int) -> int:
    """Count the batches of pictures in an epoch."""
    return sum(-(-len(numbers) // batch) for numbers in pictures)


def _batches(pictures: _Pictures, batch: int, generator: torch.Generator) -> Iterator[tuple[int, list[int]]]:
    """Draw batches of pictures of one group, with its number, in random order, epoch after epoch."""
    while True:
        batches: list[tuple[int, list[int]]] = []
        for group, numbers in enumerate(pictures):
            order = [numbers[int(place)] for place in torch.randperm(len(numbers), generator=generator)]
            batches += [(group, order[start : start + batch]) for start in range(0, len(order), batch)]
        for place in torch.randperm(len(batches), generator=generator).tolist():
            yield batches[place]


def _standardise(model: FixationDensity, groups: Sequence[Viewed], pictures: _Pictures) -> Tensor:
    """Let the readouts begin with the mean of each channel at 0; returns the standard deviations of all channels."""
    means = []
    deviations = []
    for name in model.layers:
        values = []
        for group, numbers in zip(groups, pictures, strict=True):
            if len(numbers):
                chosen = numbers[:: max(1, len(numbers) // _STANDARDISED)]
                maps = group.features.maps[name][torch.as_tensor(chosen)].float()
                values.append(maps.transpose(0, 1).flatten(1))
        by_channel = torch.cat(values, 1)
        means.append(by_channel.mean(1))
        deviations.append(by_channel.std(1).clamp(min=1e-3))  # a channel may be 0 everywhere
    scale = torch.cat(deviations)
    with torch.no_grad():
        model.shift.sub_((model.read / scale) @ torch.cat(means))
    return scale


@torch.no_grad()
def maps_of(model: FixationDensity, group: Viewed, pictures: Sequence[int], batch: int = 16) -> list[Tensor]:
    """Compute the map of each picture.

    Args:
        model: the model.
        group: pictures of one size.
        pictures: numbers of the pictures.
        batch: number of pictures that are computed together.

    Returns:
        Maps `(1, rows, columns)`.
    """
    maps: list[Tensor] = []
    for start in range(0, len(pictures), batch):
        of_batch = model.map(group.some(pictures[start : start + batch]), group.size)
        maps += [of_picture[None] for of_picture in of_batch]
    return maps


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
    """Fit oculomotor biases and gains to the next fixations, given the maps.

    Args:
        model: the model; its oculomotor biases begin anew.
        groups: pictures of one size each.
        maps: maps of the pictures of each group, `(1, rows, columns)` or one for each person.
        pictures: numbers of the pictures of each group to fit to.
        fit: settings of the fit.
        rate: highest learning rate.
        title: title of the progress bar.
    """
    generator = torch.Generator().manual_seed(fit.seed)
    model.oculomotor = OculomotorBias()
    to_predict: list[dict[int, tuple[Tensor, Events]]] = []  # map and fixations of each picture of a group
    for group, numbers, of_group in zip(groups, pictures, maps, strict=True):
        cells = cells_of(group.size)
        events_of_group = (Events.of(group.paths[picture], group.size, cells) for picture in numbers)
        to_predict.append(dict(zip(numbers, zip(of_group, events_of_group, strict=True), strict=True)))
    batches = _batches(pictures, fit.batch, generator)

    def loss_of(_: int) -> Tensor | None:
        number, batch = next(batches)
        size = groups[number].size
        centre = model.centre_bias(size).detach()
        losses = []
        for picture in batch:
            # A quarter of the computation: the likelihood of a fixation given that it is on these cells has the same
            # parameters.
            row, column = torch.randint(_EVERY, (2,), generator=generator).tolist()
            corner = row, column
            maps_of_picture, events_of_picture = to_predict[number][picture]
            events = _events_on(events_of_picture, corner, size, generator)
            if len(events.cell):
                losses.append(_saccade_loss(model, maps_of_picture, centre, events, size, corner))
        return torch.stack(losses).mean() if losses else None

    steps = fit.saccade_epochs * _steps(pictures, fit.batch)
    descend(model.oculomotor.parameters(), loss_of, steps, rate, clip=None, decay=1e-3, rise=0.2, title=title)


def _events_on(events: Events, corner: tuple[int, int], size: tuple[int, int], generator: torch.Generator) -> Events:
    """Draw events on every second row and column of cells; padding before all their fixations is cut off."""
    columns = cells_of(size)[1]
    row = events.cell // columns
    column = events.cell % columns
    is_on = (row % _EVERY == corner[0]) & (column % _EVERY == corner[1])
    numbers = is_on.nonzero()[:, 0]
    drawn = events.some(numbers[torch.randperm(len(numbers), generator=generator)[:_EVENTS]])
    if not len(drawn.cell):
        return drawn
    longest = int((~drawn.before[..., 0].isnan()).sum(1).max())
    return drawn._replace(before=drawn.before[:, -longest:])


def _saccade_loss(
    model: FixationDensity,
    maps: Tensor,
    centre: Tensor,
    events: Events,
    size: tuple[int, int],
    corner: tuple[int, int],
) -> Tensor:
    """Average the negative log likelihood of events by all terms, on every second row and column of cells."""
    terms = {"map": _for_events(maps, events), "centre bias": centre[None]}
    conditional = model.given(terms, size, events.before, (*corner, _EVERY))
    log_density = torch.stack([*conditional.values()]).sum(0)
    columns = cells_of(size)[1]
    row = events.cell // columns // _EVERY
    column = events.cell % columns // _EVERY
    return F.cross_entropy(log_density.flatten(1), row * log_density.shape[-1] + column)


def _for_events(maps: _MapsOfPicture, events: Events) -> Tensor:
    """Return the map of each event."""
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
    """Score a model on the fixations of pictures, all but the first of each path.

    Args:
        model: gives centre bias and oculomotor biases.
        group: pictures of one size.
        maps: the map of each picture.
        pictures: numbers of the pictures, P.
        conditional: whether the scanpath before a fixation is given; then some fixations are drawn.
        without: sets of terms to leave out.
        raster: `(columns, rows)` of the bins; densities are sums over them.

    Returns:
        For each set of terms NSS, AUC and log likelihood in bits above uniform, means of each picture `(P, 3)`.
    """
    size = group.size
    generator = torch.Generator().manual_seed(0)  # the same fixations for all models
    centre = model.centre_bias(size)[None]
    by_picture: list[list[Tensor]] = []  # for each set of terms
    for maps_of_picture, picture in zip(maps, pictures, strict=True):
        events = Events.of(group.paths[picture], size, raster[::-1])
        if conditional:
            events = events.some(torch.randperm(len(events.cell), generator=generator)[:_SCORED])
        terms = {"centre bias": centre, "map": _for_events(maps_of_picture, events)}
        if conditional:
            terms = model.given(terms, size, events.before)
        densities = (_density(terms, names, raster).expand(len(events.cell), -1) for names in without)
        by_picture.append([_scores(density, events.cell) for density in densities])
    if not by_picture:
        return [centre.new_zeros(0, 3) for _ in without]
    return [torch.stack(of_terms) for of_terms in zip(*by_picture, strict=True)]


def _density(terms: dict[str, Tensor], left_out: Sequence[str], raster: tuple[int, int]) -> Tensor:
    """Sum the density of terms `(E or 1, rows, columns)`, without some, in the bins of a raster, `(E or 1, N)`."""
    log_density = torch.zeros_like(terms["map"][:1])
    for name, term in terms.items():
        if name not in left_out:
            log_density = log_density + term
    log_density = log_density - log_density.flatten(1).logsumexp(1)[:, None, None]
    density = cell_saliency(log_density.exp(), *raster)
    return density / density.sum(1, keepdim=True)


def _scores(density: Tensor, cell: Tensor) -> Tensor:
    """Average NSS, AUC and log likelihood in bits above uniform of fixations in cells of densities `(E, N)`.

    They are `nss`, `auc` and `log_likelihood` of `semfov.metrics.scanpath`, for many densities at once.
    """
    at_fixation = density.gather(1, cell[:, None])[:, 0]
    z = (at_fixation - density.mean(1)) / density.std(1, unbiased=False).clamp(min=1e-12)
    lower = (density < at_fixation[:, None]).float().mean(1)
    # Ties count half, so that a density that is the same everywhere has an AUC of one half.
    equal = (density == at_fixation[:, None]).float().mean(1)
    bits = (at_fixation * density.shape[1]).log2()
    return torch.stack([z.mean(), (lower + equal / 2).mean(), bits.mean()])
