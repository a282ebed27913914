"""The density of fixations against loops, saliency of cells, and what glimpses show."""

import math
import weakref

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates

from semfov import Detections, Grid
from semfov.detection import FeatureMaps, Placement
from semfov.gaze.saliency import FixationDensity, OculomotorBias, cell_saliency, features_so_far, fixation_density
from semfov.gaze.saliency.fixation_density import cells_of
from semfov.gaze.saliency.oculomotor import _LENGTHS, _NEAR
from tests.refusals import refused, unusable
from tests.small import draw, rand


@pytest.fixture
def model():
    torch.manual_seed(0)
    made = FixationDensity({"fine": 3, "coarse": 5}, readouts=2, units=4, centre=-3 * rand(4, 5))
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return made.double().requires_grad_(False)


@pytest.fixture
def maps():
    return {"fine": rand(2, 3, 12, 16).double(), "coarse": rand(2, 5, 6, 8).double()}


def nothing():
    return Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 2), torch.zeros(1, 0, dtype=torch.bool))


@pytest.mark.parametrize("size", [(39, 52), (60, 80), (300, 200), (1, 400), (700, 5)])
def test_densities_of_pictures_of_any_size_sum_to_one(model, maps, size):
    path = torch.rand(2, 3, 2, dtype=torch.float64) * torch.tensor([size[1], size[0]])
    for scanpath in (None, path):
        density = model(maps, size, scanpath)
        assert density.shape == (2, *size)
        torch.testing.assert_close(density.exp().sum((1, 2)), torch.ones(2, dtype=torch.float64))


def test_one_map_at_a_time_is_resized(monkeypatch):
    """The twin of the next test checks the sum."""
    resize, resized, most = fixation_density.on_picture, [], []

    def watched(*arguments):
        most.append(sum(each() is not None for each in resized))
        made = resize(*arguments)
        resized.append(weakref.ref(made))
        return made

    monkeypatch.setattr(fixation_density, "on_picture", watched)
    layers = {"fine": 3, "middle": 2, "coarse": 2, "coarsest": 2}
    density = FixationDensity(layers, units=4).requires_grad_(False)
    features = {name: rand(1, channels, 3 + 3 * k, 4 + 4 * k) for k, (name, channels) in enumerate(layers.items())}
    density.map(features, (300, 400))
    assert len(most) == 4
    assert max(most) <= 1


def test_the_map_equals_loops(model, maps):
    """Twin: interpolation by scipy, and sums over channels and cells in NumPy."""
    rows, columns = cells_of((300, 400))
    assert (rows, columns) == (39, 52)
    hidden = np.zeros((8, rows, columns)) + model.shift.numpy()[:, None, None]
    start = 0
    for name, channels in model.layers.items():
        values = maps[name][1].numpy()
        height, width = values.shape[1:]
        y = (np.arange(rows) + 0.5) * height / rows - 0.5
        x = (np.arange(columns) + 0.5) * width / columns - 0.5
        for channel in range(channels):
            at = map_coordinates(values[channel], np.meshgrid(y, x, indexing="ij"), order=1, mode="nearest")
            hidden += model.read.numpy()[:, start + channel, None, None] * at
        start += channels
    hidden = np.maximum(hidden, 0).reshape(2, 4, rows, columns)
    sigma = math.exp(model.blur)
    total = np.zeros((rows, columns))
    for part in range(2):
        mixed = np.einsum("nu,uyx->nyx", model.mix[part].numpy(), hidden[part])
        mixed = np.maximum(mixed + model.mix_shift[part].numpy()[:, None, None], 0)
        value = np.einsum("n,nyx->yx", model.out[part].numpy(), mixed)
        for axis, count in ((0, rows), (1, columns)):
            steps = np.arange(count)
            kernel = np.exp(-((steps[:, None] - steps) ** 2) / (2 * sigma**2))
            kernel /= kernel.sum(1, keepdims=True)
            value = np.moveaxis(np.tensordot(kernel, np.moveaxis(value, axis, 0), 1), 0, axis)
        total += value / 2
    np.testing.assert_allclose(model.map(maps, (300, 400))[1].numpy(), total, atol=1e-9)


def test_maps_are_read_where_the_picture_lies_on_the_canvas(model):
    """A map that holds the place of its pixels on the canvas gives the place of the cells."""
    plain = FixationDensity({"place": 1}, units=1).double().requires_grad_(False)
    for parameter, value in ((plain.read, 1.0), (plain.mix, 1.0), (plain.out, 1.0), (plain.blur, -9.0)):
        parameter.fill_(value)
    placement = Placement((400, 200), (0.5, 0.5), (0, 50))
    down = (torch.arange(25, dtype=torch.float64) + 0.5) * 8
    map = down[:, None].expand(1, 1, 25, 25)
    features = FeatureMaps({"place": map}, (200, 200), placement, nothing())
    read = plain.map(features, (200, 400))[0]
    rows = (torch.arange(26, dtype=torch.float64) + 0.5) * 200 / 26 * 0.5 + 50
    torch.testing.assert_close(read, rows[:, None].expand(26, 52))


def test_terms_add_up_and_may_be_left_out_and_a_new_model_has_no_oculomotor_biases(model, maps):
    density = model(maps, (39, 52), without=["map"])
    expected = torch.nn.functional.interpolate(model.centre[None, None], (39, 52), mode="bilinear")[0, 0]
    expected = (model.centre_weight * expected).flatten().log_softmax(0).view(39, 52)
    torch.testing.assert_close(density, expected.expand(2, 39, 52))
    flat = model(maps, (39, 52), without=["map", "centre bias"])
    torch.testing.assert_close(flat, torch.full_like(flat, -math.log(39 * 52)))
    refused("without", model, maps, (39, 52), without=["centre"])
    path = 40 * rand(2, 3, 2).double()
    terms = model.terms(maps, (39, 52), path)
    assert list(terms) == ["map", "centre bias", "oculomotor biases"]
    total = torch.stack([*terms.values()]).sum(0)
    torch.testing.assert_close(model(maps, (39, 52), path), total.flatten(1).log_softmax(1).view_as(total))
    model = FixationDensity({"fine": 3, "coarse": 5}).double()
    path = 40 * rand(2, 3, 2).double()
    torch.testing.assert_close(model(maps, (39, 52), path), model(maps, (39, 52)))


def oculomotor_by_loops(bias, path, place):
    """The formula of the docstring, by `numpy.interp` and angles."""
    last, ahead = path[-1], place - path[-1]
    length, angle = math.hypot(*ahead), math.atan2(ahead[1], ahead[0])
    waves = [1, math.cos(angle), math.sin(angle), math.cos(2 * angle), math.sin(2 * angle)]
    waves += [math.cos(4 * angle), math.sin(4 * angle)]
    total = sum(
        np.interp(length, _LENGTHS, table) * wave for table, wave in zip(bias.saccade.tolist(), waves, strict=True)
    )
    if len(path) > 1:
        step = last - path[-2]
        turn = angle - math.atan2(step[1], step[0])
        for k, table in enumerate(bias.turn.tolist(), 1):
            total += np.interp(length, _LENGTHS, table) * math.cos(k * turn)
    for age, earlier in enumerate(path[:-1][::-1]):
        table = [*bias.back.tolist()[min(age, 3)], 0.0]
        total += np.interp(math.hypot(*(place - earlier)), _NEAR, table)
    return total


@pytest.mark.parametrize("fixations", [1, 2, 3, 7])
def test_oculomotor_biases_equal_loops(fixations):
    torch.manual_seed(fixations)
    bias = OculomotorBias().double().requires_grad_(False)
    for table in bias.parameters():
        table.normal_()
    paths, places = torch.rand(3, fixations, 2, dtype=torch.float64), torch.rand(20, 2, dtype=torch.float64)
    expected = [[oculomotor_by_loops(bias, path.numpy(), place.numpy()) for place in places] for path in paths]
    torch.testing.assert_close(bias(paths, places), torch.tensor(expected, dtype=torch.float64))
    if fixations > 1:
        longer = torch.cat([torch.full((3, 2, 2), torch.nan, dtype=torch.float64), paths], 1)
        torch.testing.assert_close(bias(longer, places), bias(paths, places))


def test_gradients_of_a_padded_path_are_finite(model, maps):
    path = (40 * rand(2, 4, 2)).double()
    path[0, :2] = torch.nan
    path[1, -1] = path[1, -2]  # a fixation that stays
    model.requires_grad_(True)
    model(maps, (39, 52), path)[:, 3, 4].sum().backward()
    assert all(parameter.grad is None or bool(parameter.grad.isfinite().all()) for parameter in model.parameters())


def test_a_saved_model_gives_the_same_density(model, maps, tmp_path):
    model.float().save(tmp_path / "model.safetensors")
    loaded = FixationDensity.from_pretrained(tmp_path / "model.safetensors")
    assert loaded.layers == model.layers
    path = 40 * rand(2, 3, 2)
    single = {name: each.float() for name, each in maps.items()}
    # Weights are stored with 11 significant bits.
    torch.testing.assert_close(loaded(single, (39, 52), path), model(single, (39, 52), path), atol=1e-2, rtol=1e-3)
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == (tmp_path / "model.safetensors").read_bytes()
    content = bytearray((tmp_path / "model.safetensors").read_bytes())
    content[-40] ^= 1
    (tmp_path / "model.safetensors").write_bytes(content)
    unusable("damaged", FixationDensity.from_pretrained, tmp_path / "model.safetensors")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fine": None}, "'fine'"),
        ({"fine": torch.rand(2, 4, 12, 16)}, "fine"),
        ({"coarse": torch.rand(5, 6, 8)}, "coarse"),
    ],
)
def test_wrong_features_are_named(model, maps, change, words):
    given = {name: each for name, each in {**maps, **change}.items() if each is not None}
    refused(words, model, given, (39, 52))


def test_draws_have_the_density_of_the_next_fixation(model, maps):
    """Pearson's chi-square of 1,000 draws in 12 regions, below its 0.9999 quantile."""
    size = (39, 52)
    terms = {name: each[:1] for name, each in model.terms(maps, size).items()}
    start = torch.tensor([[20.0, 15.0]], dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    paths = model.sample(terms, size, start.expand(1_000, -1), 2, generator)
    probability = model.given(terms, size, start[:, None])
    probability = torch.stack([*probability.values()]).sum(0).flatten().softmax(0).view(39, 52)
    x, y = paths[:, 1].add(0.5).floor().long().clamp(min=0).unbind(1)
    region = torch.arange(39)[:, None] // 13 * 4 + torch.arange(52) // 13
    expected = torch.zeros(12, dtype=torch.float64).index_add_(0, region.flatten(), probability.flatten()) * 1_000
    counts = region[y, x].bincount(minlength=12)
    assert float(((counts - expected) ** 2 / expected).sum()) < 37.4


def test_draws_repeat_with_the_seed(model, maps):
    size = (30, 40)
    terms = {name: each[:1] for name, each in model.terms(maps, size).items()}
    start = torch.full((4, 2), 10.0, dtype=torch.float64)
    draws = [model.sample(terms, size, start, 5, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    inside = (draws[0] >= -0.5) & (draws[0] < torch.tensor([39.5, 29.5]))
    assert bool(inside.all())


@given(st.integers(1, 23), st.integers(1, 23), st.integers(1, 8), st.integers(1, 8))
def test_mean_and_max_equal_a_brute_force(height: int, width: int, columns: int, rows: int) -> None:
    saliency = np.random.default_rng(height + 100 * width).random((2, height, width))
    # Split every pixel into rows x columns pieces: then every cell consists of height x width whole pieces.
    pieces = saliency.repeat(rows, 1).repeat(columns, 2)
    cells = pieces.reshape(2, rows, height, columns, width).transpose(0, 1, 3, 2, 4).reshape(2, rows * columns, -1)
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 2e-6)):
        tensor = torch.from_numpy(saliency).to(dtype)
        mean, largest = cell_saliency(tensor, columns, rows), cell_saliency(tensor, columns, rows, "max")
        np.testing.assert_allclose(mean.numpy(), cells.mean(-1), atol=tolerance)
        np.testing.assert_allclose(largest.numpy(), cells.max(-1), atol=tolerance)


def test_bad_input(model):
    refused("saliency", cell_saliency, torch.zeros((4, 4)), 2, 2, "mean")
    refused("saliency", cell_saliency, torch.zeros((1, 1, 4, 4)), 2, 2, "mean")
    refused("saliency", cell_saliency, torch.zeros((1, 0, 4)), 2, 2, "mean")
    refused("columns", cell_saliency, torch.zeros((1, 4, 4)), 0, 2, "mean")
    refused("reduction", cell_saliency, torch.zeros((1, 4, 4)), 2, 2, "sum")
    other = FixationDensity({"fine": 5, "coarse": 3}, readouts=2, units=4, centre=torch.zeros(4, 5))
    refused("layers", other.load_state_dict, model.state_dict())


def test_cells_are_those_of_the_grid_with_gradients_and_in_one_graph_and_maps_of_integers_are_refused():
    saliency = torch.zeros(1, 47, 61)
    saliency[0, 33, 50] = 1.0
    expected = Grid(7, 5, (61, 47)).cell_of(torch.tensor([50.0, 33.0]))
    for reduction in ("mean", "max"):
        assert cell_saliency(saliency, 7, 5, reduction).argmax() == expected
    refused("saliency", cell_saliency, torch.zeros(1, 4, 4, dtype=torch.long), 2, 2)
    saliency = torch.rand(2, 5, 7, dtype=torch.float64, requires_grad=True)
    for reduction in ("mean", "max"):
        assert torch.autograd.gradcheck(lambda x, how=reduction: cell_saliency(x, 3, 2, how), saliency)
        compiled = torch.compile(cell_saliency, fullgraph=True, backend="eager")
        torch.testing.assert_close(compiled(saliency, 3, 2, reduction), cell_saliency(saliency, 3, 2, reduction))


PLACE = Placement((80, 60), (0.5, 0.5), (2.0, 4.0))
CANVAS = (48, 40)


def views(count=5):
    none = Detections(torch.zeros(count, 0, 4), torch.zeros(count, 0, 1), torch.zeros(count, 0, dtype=torch.bool))
    maps = {"backbone8": draw(count, 3, 5, 6).float(), "head16": draw(count, 2, 3, 3, seed=1).float()}
    return FeatureMaps(maps, CANVAS, PLACE, none)


def test_each_place_has_the_features_of_the_closest_look():
    seen, fixations = views(), torch.from_numpy(np.random.default_rng(0).uniform(0, (79, 59), (5, 2)))
    path = fixations[[3, 1, 4]] + 0.1
    got = features_so_far(seen, fixations, path[None])
    assert got.placement == PLACE
    for name, maps in seen.maps.items():
        height, width = maps.shape[-2:]
        for row in range(height):
            for column in range(width):
                x = ((column + 0.5) * CANVAS[0] / width - 2.0) / 0.5 - 0.5
                y = ((row + 0.5) * CANVAS[1] / height - 4.0) / 0.5 - 0.5
                away = [np.hypot(*(fixations[view].numpy() - (x, y))) for view in (3, 1, 4)]
                expected = maps[(3, 1, 4)[int(np.argmin(away))], :, row, column]
                assert torch.equal(got.maps[name][0, :, row, column], expected)


def test_a_shorter_path_is_as_if_alone():
    seen, fixations = views(), torch.tensor([[5.0, 5], [70, 5], [40, 30], [5, 50], [70, 50]])
    short = torch.full((2, 3, 2), torch.nan)
    short[0], short[1, 2] = fixations[[0, 2, 4]], fixations[1]
    both, alone = features_so_far(seen, fixations, short), features_so_far(seen, fixations, short[1:, 2:])
    for name in seen.maps:
        assert torch.equal(both.maps[name][1], alone.maps[name][0])
        assert torch.equal(both.maps[name][1], seen.maps[name][1])
    refused("scanpath", features_so_far, seen, fixations, torch.full((1, 2, 2), torch.nan))
    refused("fixations", features_so_far, seen, fixations[:3], short)
