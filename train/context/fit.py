"""Count the context of searches: in which cells the classes occur, and which classes occur near each other."""

import json
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from semfov.belief import ContextPrior
from semfov.belief.context import reaches
from semfov.detection.class_names import COCO_CLASSES
from semfov.errors import DataError, check
from semfov.fit.outputs import model_path, training_of, write_outputs
from semfov.metrics.averages import standard_error
from semfov.runs.samples import SampleSettings, collect_samples
from semfov.runs.setup import make_scenes
from semfov.runs.tables import table
from train.context.settings import FitContextConfig, ObjectPlaces, read_places
from train.context.weights import fit_weights, make_cases


def fit_context(config: FitContextConfig) -> None:
    """Count the context, evaluate it on held-out photographs, fit its weights, and write all results."""
    check(config.holdout >= 2, "holdout", "2 or more", config.holdout)
    has_table = config.heights is None or config.table is not None
    check(has_table, "heights", "no heights unless `table` is given too", config.heights)
    sampler, samples, scenes = None, None, None
    if config.weigh:
        settings = SampleSettings.of(config)
        sampler = collect_samples(settings, (config.cache or config.out) / "samples", config.where, "looking")
        samples, scenes = sampler.all(), sampler.scenes
    scenes = make_scenes(config.data, COCO_CLASSES) if scenes is None else scenes
    places = read_places(scenes, config)
    held_out = [index % config.holdout == 0 for index in range(len(places))]
    training = [place for place, out in zip(places, held_out, strict=True) if not out]
    from_table = table_prior(config, scenes.classes)
    prior = count_context(training, scenes.classes, config) if from_table is None else from_table
    judged = judge_context(
        prior, [place for place, out in zip(places, held_out, strict=True) if out], config.min_objects
    )
    weights = dict.fromkeys(("evidence", "map"), (1.0, 1.0))
    metadata = training_of(config, scenes, "table", "source", "heights") | prior.metadata
    if sampler is not None and samples is not None:
        usable = [index for index, out in enumerate(held_out) if not out]
        folds = cross_fit(places, usable, scenes.classes, config, from_table)
        for kind in weights:
            weights[kind] = fit_weights(make_cases(kind, sampler, samples, folds, places, config))
        metadata |= sampler.eye.settings()
    model = ContextPrior(
        scenes.classes, prior.place, prior.cooccurrence, config.edges, weights=weights, metadata=metadata
    )
    path = model_path(config, "context")
    model.save(path)
    text = context_report(judged, weights, len(training), config)
    write_outputs(config, text, ("judged.json", json.dumps(judged, indent=2) + "\n"), path)


def count_context(places: Sequence[ObjectPlaces], classes: Sequence[str], config: FitContextConfig) -> ContextPrior:
    """Count the context in photographs.

    Args:
        places: the objects of each photograph, on the grid.
        classes: names of the K classes.
        config: the settings.

    Returns:
        The prior, with log-odds of the place and log-ratios of co-occurrence.
    """
    chance = occupation(places, config.place_smoothing)
    odds = chance.logit()
    size = config.resolution, config.resolution
    place = (odds - odds.mean(-1, keepdim=True)).unflatten(-1, size)
    observed, expected = count_pairs(places, chance, config.edges)
    ratio = shrunk_ratio(observed, expected, config.class_smoothing, config.pair_smoothing)
    return ContextPrior(classes, place, ratio.log(), config.edges)


def table_prior(config: FitContextConfig, classes: Sequence[str]) -> ContextPrior | None:
    """Make the prior from the table in the settings; None if they name none."""
    table = config.table
    if table is None:
        return None
    source = config.source or table.name
    return ContextPrior.from_table(table, classes, source=source, places=config.heights, edges=config.edges)


def cross_fit(
    places: Sequence[ObjectPlaces],
    usable: Sequence[int],
    classes: Sequence[str],
    config: FitContextConfig,
    fixed: ContextPrior | None = None,
) -> list[tuple[ContextPrior, list[int]]]:
    """Pair priors with photographs to fit their weights on, such that no prior was counted on its photographs.

    Args:
        places: the objects of all photographs.
        usable: indices of the photographs that are not held out.
        classes: names of the K classes.
        config: the settings.
        fixed: a prior that was not counted on photographs; it is used in every fold.

    Returns:
        For each fold the prior, and the indices of the photographs to fit its weights on.
    """
    rich = [index for index in usable if places[index].objects >= config.min_objects]
    chosen = rich[:: max(1, len(rich) // config.weigh)][: config.weigh]
    folds = []
    for fold in range(config.folds):
        part = [index for position, index in enumerate(chosen) if position % config.folds == fold]
        others = set(usable).difference(part)
        prior = count_context([places[index] for index in sorted(others)], classes, config) if fixed is None else fixed
        folds.append((prior, part))
    return folds


def occupation(places: Sequence[ObjectPlaces], smoothing: float) -> Tensor:
    r"""Estimate the probability that a class occupies each cell, given that it is in the picture.

    .. math:: P(k \in x) = \frac{n_k(x) + s \, \bar P(x)}{n_k + s}

    where :math:`n_k` pictures contain the class, :math:`n_k(x)` of them in cell x, and :math:`\bar P` is the same
    ratio over all classes together.

    Args:
        places: the objects of the photographs.
        smoothing: s, the number of pictures that the average over classes counts as.

    Returns:
        Probabilities `(K+1, X·Y)`.

    Raises:
        DataError: no photograph contains a class to search for.
    """
    cells, components = places[0].occupied.shape
    there, pictures = torch.zeros(components, cells), torch.zeros(components)
    for place in places:
        there[place.targets] += place.occupied[:, place.targets].t().float()
        pictures[place.targets] += 1
    if not pictures.any():
        raise DataError("data: no photograph contains a class that may be searched for; raise max_target_area")
    average = (there.sum(0) + 0.5) / (pictures.sum() + 1)
    return (there + smoothing * average) / (pictures[:, None] + smoothing)


def count_pairs(places: Sequence[ObjectPlaces], chance: Tensor, edges: Sequence[float]) -> tuple[Tensor, Tensor]:
    r"""Count the cells of class k by their distance to the nearest object of class j.

    .. math:: O_{kjn} = \sum_i \sum_{x \in k} [\text{band}_j(x) = n], \qquad
              E_{kjn} = \sum_i \sum_x \frac{|k| \, P(k \in x)}{\sum_y P(k \in y)} [\text{band}_j(x) = n]

    The sums run over the pictures i that contain both classes, j ≠ k. O is the observed count. E is the count expected
    if the position of k depended on its usual place alone.

    Args:
        places: the objects of the photographs.
        chance: `(K+1, X·Y)`, probability of each class in each cell (`occupation`).
        edges: `(N-1,)`, borders between the bands of distance.

    Returns:
        Observed and expected counts, both `(K+1, K+1, N)`.
    """
    components = len(chance)
    observed = torch.zeros(components, components, len(edges) + 1)
    expected = torch.zeros_like(observed)
    for place in places:
        present = place.occupied.any(0).nonzero()[:, 0]
        targets = torch.tensor(place.targets, dtype=torch.long)
        if not len(targets) or len(present) < 2:
            continue
        there = torch.stack(list(reaches(place.occupied[None, :, present].float(), place.grid, edges)), -1)[0]
        bands = there.diff(dim=-1, prepend=torch.zeros_like(there[..., :1]))
        own = place.occupied[:, targets].t().float()
        share = chance[targets] / chance[targets].sum(-1, keepdim=True) * own.sum(-1, keepdim=True)
        other = (targets[:, None] != present)[..., None]
        observed[targets[:, None], present] += torch.einsum("kx,xjn->kjn", own, bands) * other
        expected[targets[:, None], present] += torch.einsum("kx,xjn->kjn", share, bands) * other
    return observed, expected


def shrunk_ratio(observed: Tensor, expected: Tensor, class_smoothing: float, pair_smoothing: float) -> Tensor:
    r"""Compute the ratio of observed to expected counts, shrunk so that rare pairs do not give extreme values.

    The ratio of a pair is shrunk towards the average ratios of its two classes, and these towards the average over all
    classes:

    .. math:: \rho_{kjn} = \frac{O_{kjn} + s \, \rho_{k \cdot n} \rho_{\cdot jn} / \rho_n}{E_{kjn} + s}, \qquad
              \rho_{k \cdot n} = \frac{\sum_j O_{kjn} + s' \rho_n}{\sum_j E_{kjn} + s'}

    Args:
        observed: O, `(K+1, K+1, N)`.
        expected: E, `(K+1, K+1, N)`.
        class_smoothing: s', the weight of the average over all classes, in cells.
        pair_smoothing: s, the weight of the averages of the two classes, in cells.

    Returns:
        Ratios `(K+1, K+1, N)`, 1 for background and on the diagonal.
    """
    every = (observed.sum((0, 1)) + 1) / (expected.sum((0, 1)) + 1)
    towards = [
        (observed.sum(axis) + class_smoothing * every) / (expected.sum(axis) + class_smoothing) for axis in (1, 0)
    ]
    both = towards[0][:, None] * towards[1] / every
    ratio = (observed + pair_smoothing * both) / (expected + pair_smoothing)
    ratio[0], ratio[:, 0] = 1, 1
    ratio.diagonal().fill_(1)
    return ratio


def judge_context(prior: ContextPrior, places: Sequence[ObjectPlaces], min_objects: int) -> list[dict[str, object]]:
    r"""Evaluate how well context predicts the position of a class when all other objects are known.

    The measure is the mean of :math:`\ln \sum_{x \in \text{goal}} \mathrm{softmax}(c)(x)` over pairs of photograph and
    class: the log probability that one fixation, drawn from context c alone, lands on the target. The control uses the
    context of other classes (`ContextPrior.permuted`).

    Args:
        prior: the context.
        places: the objects of the held-out photographs.
        min_objects: photographs with fewer objects are left out.

    Returns:
        For each kind of context: its name, the mean log probability, the gain over no context with its standard error
        over photographs, and the number of pairs.

    Raises:
        DataError: no held-out photograph has enough objects.
    """
    other = prior.permuted()
    choices = {
        "nothing": (prior, (0.0, 0.0)),
        "place": (prior, (1.0, 0.0)),
        "co-occurrence": (prior, (0.0, 1.0)),
        "both": (prior, (1.0, 1.0)),
        "both, of other classes": (other, (1.0, 1.0)),
    }
    judges = [place for place in places if place.targets and place.objects >= min_objects]
    if not judges:
        raise DataError(
            f"data: none of the held-out photographs has a target and {min_objects} objects or more; give more "
            "photographs or lower min_objects"
        )
    rows: list[dict[str, object]] = []
    without: list[Tensor] = []
    for name, (context, weights) in choices.items():
        logs = [
            torch.stack([_landing(context, place, target, weights) for target in place.targets]) for place in judges
        ]
        without = without or logs
        gains = np.array([float((own - plain).mean()) for own, plain in zip(logs, without, strict=True)])
        mean, pairs = float(torch.cat(logs).mean()), sum(map(len, logs))
        error = float(standard_error(gains))
        rows.append(
            {"context": name, "log_likelihood": mean, "gain": float(gains.mean()), "error": error, "pairs": pairs}
        )
    return rows


def _landing(context: ContextPrior, place: ObjectPlaces, target: int, weights: tuple[float, float]) -> Tensor:
    """Log probability that a fixation drawn from the context lands on the target."""
    value = context(place.occupied[None].float(), place.grid, target, weights)[0]
    return value[place.occupied[:, target]].logsumexp(0) - value.logsumexp(0)


def context_report(
    judged: list[dict[str, object]], weights: dict[str, tuple[float, float]], count: int, config: FitContextConfig
) -> str:
    """Report the fitted context and its evaluation on held-out photographs as Markdown."""
    rows = [
        [str(row["context"]), f"{row['log_likelihood']:.3f}", f"{row['gain']:+.3f} ± {row['error']:.3f}"]
        for row in judged
    ]
    weighed = [[kind, f"{place:.2g}", f"{co_occurrence:.2g}"] for kind, (place, co_occurrence) in weights.items()]
    counted = f"Counted on {count} photographs" if config.table is None else "From a table"
    fitted = f"fitted on looks at {config.weigh} of" if config.weigh else "not fitted on looks at"
    return "\n".join(
        [
            f"{counted}, evaluated on {judged[0]['pairs']} pairs of photograph and class from held-out photographs "
            f"(one in {config.holdout}). The log likelihood is the mean log probability that a fixation drawn from "
            "context alone lands on the target, when all other objects are known. The gain is the improvement over no "
            "context, as a mean over photographs.",
            "",
            *table([["context", "log likelihood", "gain ± standard error"], *rows]),
            "",
            f"Weights of the context when it is combined with a belief, {fitted} the photographs:",
            "",
            *table([["belief", "place", "co-occurrence"], *weighed]),
            "",
        ]
    )
