"""Fuzz functions on tensors: the sensor, grids, fusion, the observation model and saliency."""

import math
from pathlib import Path

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.fuzz.runner import Case, Draw
from semfov import DirichletStatistics, FovealObservationModel, Grid, foveate, fusion
from semfov.belief import fuse
from semfov.gaze.saliency import cell_saliency, itti_koch_saliency, vocus2_saliency

NUMBERS = (0.0, -1.0, 1e-30, 1e-3, 1.0, 37.5, 1e6, 1e30, math.inf, -math.inf, math.nan)
WRONG = {"zero": 0.0, "negative": -0.2, "nan": math.nan, "inf": math.inf}
LIKELIHOODS = ("ordinary", "one zero", "sharp", "zeros", "tiny", "huge", "negative", "nan", "inf")
BETAS = ("prior", "prior", "grown", "grown", "tiny", "large", "zero", "negative", "nan", "inf")
SCORES = ("ordinary", "corner", "zeros", "unscaled", "tiny", "negative", "nan", "inf")
EDGES = (0.25, 0.5)
DISTANCES = {
    "ordinary": 0.3, "edge": EDGES[0], "far": 9.5, "pixels": 320.0, "infinite": math.inf, "negative": -0.1,
    "nan": math.nan,
}  # fmt: skip


def fixations(draw: Draw, _: Path) -> Case:
    """`foveate`, with any image, fixation and window: a finite view with the image's shape and in a bounded range.

    A band is a difference of two averages, so its values are at most the image's range r. K bands with weights in
    [0, 1] then keep the view within K r of the image's values.

    Args:
        draw: random choices.

    Returns:
        The case.
    """

    def number(low: float, high: float) -> float:
        ordinary = draw.integer(0, 9, "ordinary") > 0
        return draw.data.draw(st.floats(low, high)) if ordinary else draw.choose(NUMBERS, "number")

    width = 5000 if draw.integer(0, 20, "wide") == 0 else draw.integer(1, 140, "width")
    height = 1 if width == 5000 else draw.integer(1, 60, "height")
    dtype = draw.choose((torch.float32, torch.float64), "dtype")
    shape = draw.integer(1, 2, "batch"), draw.integer(1, 3, "channels"), height, width
    image = torch.from_numpy(draw.rng.random(shape)).to(dtype)
    flat = draw.integer(0, 3, "flat") == 0
    if flat:
        image = torch.full_like(image, 0.25)
    gaze = torch.tensor([number(-500.0, 500.0), number(-500.0, 500.0)], dtype=torch.float64)
    sigma, growth, levels = number(1e-3, 1e3), number(0.25, 4.0), draw.integer(-1, 7, "levels")
    convention = draw.choose(("kornia", "opencv", "kornia", "opencv", "gabor"), "convention")
    positive = bool((torch.tensor([sigma, growth]) > 0).all())  # in single precision

    def check(view: Tensor) -> None:
        assert view.shape == image.shape
        assert view.dtype == dtype
        assert bool(torch.isfinite(view).all()), "the view is not finite"
        assert float((view - 0.5).abs().max()) <= 0.5 + max(levels, 1)
        if flat or (math.isinf(sigma) and math.isfinite(growth)):
            torch.testing.assert_close(view, image, rtol=0, atol=1e-5)

    return Case(
        lambda: foveate(image, gaze, sigma=sigma, levels=levels, growth=growth, convention=convention),
        check,
        may=not (positive and bool(torch.isfinite(gaze).all()) and levels >= 0 and convention != "gabor"),
    )


def boxes_on_grids(draw: Draw, _: Path) -> Case:
    """`Grid.footprint` and `cell_of`, with boxes at any place, of any size, or invalid: as a loop over cells."""
    columns, rows = (7 - draw.integer(0, 7, side) for side in ("columns", "rows"))
    # With these sizes the borders of cells are binary fractions, which are exact in floating point.
    unit = draw.choose((1, 8, 32, 64, 8, 32, 0), "unit")
    boxes = draw.rng.integers(-8, 8 * max(columns, rows, 1), (5, 4)) * unit / 8
    boxes[0] = np.sort(boxes[0].reshape(2, 2), axis=0).ravel()
    odd = draw.choose(("none", "none", "huge", "huge", "nan", "inf"), "odd")
    if odd != "none":
        value = {"nan": np.nan, "inf": draw.rng.choice([-np.inf, np.inf]), "huge": 1e30}[odd]
        boxes[1, draw.rng.integers(4)] = value
    rule = draw.choose(("overlap", "centre", "box_centre", "soft"), "rule")
    tensor = torch.from_numpy(boxes).to(draw.choose((torch.float32, torch.float64), "dtype"))

    def find() -> tuple[Grid, Tensor]:
        grid = Grid(columns, rows, (columns * unit, rows * unit))
        return grid, grid.footprint(tensor, rule)

    def check(found: tuple[Grid, Tensor]) -> None:
        grid, footprint = found
        assert footprint.shape == (5, columns * rows)
        if footprint.is_floating_point():
            assert bool(((footprint >= 0) & (footprint <= 1)).all())
        for box, mask in zip(boxes, (footprint > 0).numpy(), strict=True):
            overlapped = np.array([overlaps(box, cell, columns, unit) for cell in range(columns * rows)])
            if rule == "overlap":
                assert (mask == overlapped).all(), (box, mask, overlapped)
            elif rule == "soft":
                assert (mask <= overlapped).all()
            elif not (box[2] > box[0] and box[3] > box[1]):
                assert not mask.any()
            elif rule == "box_centre":
                assert mask.sum() == 1
        points = tensor[:, :2].double()
        for point, cell in zip(points.tolist(), grid.cell_of(points).tolist(), strict=True):
            column, row = (math.floor((value + 0.5) / unit) for value in point)
            assert cell == min(max(row, 0), rows - 1) * columns + min(max(column, 0), columns - 1)

    return Case(find, check, may=columns * rows * unit == 0 or odd in ("nan", "inf"))


def overlaps(box: np.ndarray, cell: int, columns: int, unit: float) -> bool:
    """Whether the overlap of box and cell has a positive area."""
    left, top = cell % columns * unit, cell // columns * unit
    width = min(box[2], left + unit) - max(box[0], left)
    height = min(box[3], top + unit) - max(box[1], top)
    return bool(width > 0 and height > 0 and box[2] > box[0] and box[3] > box[1])


def fusion_rules(draw: Draw, _: Path) -> Case:
    """`kaplan`, `product`, `sum` and `fuse`, with any parameters and likelihoods: as in extended precision."""
    classes, rng = draw.integer(2, 9, "classes"), draw.rng
    rule, whole = draw.choose(("kaplan", "product", "sum"), "rule"), draw.flag("fuse")
    kind, start = draw.choose(LIKELIHOODS, "likelihood"), draw.choose(BETAS, "beta")
    dtype = draw.choose((torch.float32, torch.float64), "dtype")
    likelihood, beta = rng.dirichlet(np.ones(classes)) + 1e-6, np.full(classes, 0.5)
    if kind == "sharp":
        likelihood = likelihood**8 + 1e-20
    elif kind in ("zeros", "tiny", "huge"):
        likelihood *= {"zeros": 0.0, "tiny": 1e-30, "huge": 1e30}[kind]
    elif kind != "ordinary":
        likelihood[rng.integers(classes)] = (WRONG | {"one zero": 0.0})[kind]
    if start == "grown":
        beta = rng.gamma(2.0, 5.0, classes) + 0.1
    elif start in ("tiny", "large"):
        beta = rng.random(classes) * (1e-6 if start == "tiny" else 1e6) + 1e-9
    elif start != "prior":
        beta[rng.integers(classes)] = WRONG[start]
    first, second = (torch.from_numpy(array).to(dtype) for array in (beta, likelihood))

    def update() -> Tensor:
        if whole:
            return fuse(first[None, None], second[None, None], torch.ones(1, 1, 1).bool(), rule)[0, 0]
        updated: Tensor = getattr(fusion, rule)(first, second)
        return updated

    def check(updated: Tensor) -> None:
        wide = [tensor.double().numpy().astype(np.longdouble) for tensor in (first, second)]
        # The product rule raises parameters to the smallest positive number before it scales them.
        scale = (1 + beta.sum()) / (beta * likelihood / likelihood.max()).sum()
        least = 10 * torch.finfo(dtype).tiny * max(scale, 1.0)
        exact = formula(rule, *wide).astype(np.float64)
        np.testing.assert_allclose(updated.numpy(), exact, rtol=40 * torch.finfo(dtype).eps, atol=least)

    return Case(update, check, may=kind in ("zeros", "negative", "nan", "inf") or start in WRONG)


def formula(rule: str, beta: np.ndarray, likelihood: np.ndarray) -> np.ndarray:
    """Make the rules as in their published formulas."""
    expected = (beta * likelihood).sum()
    if rule == "kaplan":
        return beta * (1 + likelihood / expected) / (1 + likelihood.min() / expected)
    if rule == "product":
        return (1 + beta.sum()) * beta * likelihood / expected
    return beta + likelihood / likelihood.sum()


def observations(draw: Draw, _: Path) -> Case:
    """`calibrate`: Bayes' rule by `math.lgamma`; statistics accept only scores on the simplex."""
    classes, rng = draw.integer(1, 5, "classes"), draw.rng
    components, levels = classes + 1, len(EDGES) + 1
    kind = draw.choose(SCORES, "scores")
    scores = rng.dirichlet(np.ones(components))
    if kind == "corner":
        scores = np.eye(components)[rng.integers(components)]
    elif kind == "tiny":
        scores = np.array([1.0 - 1e-300, *[1e-300] * (components - 1)])
    elif kind in ("zeros", "unscaled"):
        scores *= 0 if kind == "zeros" else 3
    elif kind != "ordinary":
        scores[rng.integers(components)] = WRONG[kind]
    look = torch.from_numpy(scores)[None]
    if draw.flag("statistics"):
        statistics, index = DirichletStatistics((components, levels), components), torch.tensor([0])

        def counted(result: DirichletStatistics) -> None:
            assert float(result.count.sum()) == float(result.count[0, 0]) == 1

        return Case(
            lambda: statistics.update(look, (index, index)),
            counted,
            may=kind in ("zeros", "unscaled", "negative", "nan", "inf"),
        )
    alpha = rng.gamma(1.0, 3.0, (components, levels, components)) + 0.05
    prior = rng.normal(0, 1, (components, levels))
    names = [f"class {n}" for n in range(classes)]
    model = FovealObservationModel(torch.from_numpy(alpha), EDGES, names, log_prior=torch.from_numpy(prior)).eval()
    place = draw.choose(DISTANCES, "distance")
    distance = float(rng.random()) if place == "ordinary" else DISTANCES[place]

    def check(calibrated: Tensor) -> None:
        level = sum(distance > edge for edge in EDGES)
        right = bayes(scores, alpha[:, level], prior[:, level])
        np.testing.assert_allclose(calibrated[0].numpy(), right, rtol=1e-9, atol=1e-12)

    return Case(
        lambda: model.calibrate(look, torch.tensor([distance], dtype=torch.float64)).detach(),
        check,
        may=kind in ("negative", "nan", "inf") or place in ("pixels", "negative", "nan"),
    )


def bayes(scores: np.ndarray, alpha: np.ndarray, prior: np.ndarray) -> np.ndarray:
    """Posterior probabilities of the classes, for scores floored at 1e-6."""
    raised = np.maximum(scores, 1e-6)
    logs = np.log(raised / raised.sum())
    logits = []
    for row, weight in zip(alpha, prior, strict=True):
        normaliser = sum(map(math.lgamma, row)) - math.lgamma(row.sum())
        logits.append(((row - 1) * logs).sum() - normaliser + weight)
    odds = np.exp(np.array(logits) - max(logits))
    return odds / odds.sum()


def saliency_maps(draw: Draw, _: Path) -> Case:
    """Both models and `cell_saliency`, with any image and grid: values in [0, 1], all 0 for a uniform image."""
    height, width, rng = draw.integer(0, 40, "height"), draw.integer(0, 70, "width"), draw.rng
    channels = draw.choose((3, 3, 3, 1), "channels")
    kind = draw.choose(("random", "flat", "spot", "bytes"), "kind")
    image = torch.from_numpy(rng.random((1, channels, height, width))).float()
    if kind == "flat":
        image = torch.full_like(image, 0.3)
    if kind == "spot" and image.numel():
        image = torch.zeros_like(image)
        image[0, :, rng.integers(height), rng.integers(width)] = 1
    if kind == "bytes":
        image = (image * 255).byte()
    model = draw.choose((vocus2_saliency, itti_koch_saliency), "model")
    columns, rows = draw.integer(0, 12, "columns"), draw.integer(0, 12, "rows")
    reduction = draw.choose(("mean", "max"), "reduction")

    def check(saliency: Tensor) -> None:
        assert saliency.shape == (1, columns * rows)
        assert bool(((saliency >= 0) & (saliency <= 1 + 1e-6)).all())
        assert kind != "flat" or not saliency.any()

    return Case(
        lambda: cell_saliency(model(image), columns, rows, reduction),
        check,
        may=channels != 3 or kind == "bytes" or height * width * columns * rows == 0,
    )
