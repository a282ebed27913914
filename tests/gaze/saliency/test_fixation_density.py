"""The density of fixations against loops, closed forms and what must hold for any density."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from semfov import Detections
from semfov.detection import FeatureMaps, Placement
from semfov.gaze.saliency import FixationDensity, OculomotorBias
from semfov.gaze.saliency.fixation_density import cells_of
from semfov.gaze.saliency.oculomotor import _LENGTHS, _NEAR
from tests.refusals import refused, unusable
from tests.small import rand


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


def test_without_map_and_biases_the_centre_bias_is_left(model, maps):
    density = model(maps, (39, 52), without=["map"])
    expected = torch.nn.functional.interpolate(model.centre[None, None], (39, 52), mode="bilinear")[0, 0]
    expected = (model.centre_weight * expected).flatten().log_softmax(0).view(39, 52)
    torch.testing.assert_close(density, expected.expand(2, 39, 52))
    flat = model(maps, (39, 52), without=["map", "centre bias"])
    torch.testing.assert_close(flat, torch.full_like(flat, -math.log(39 * 52)))
    refused("without", model, maps, (39, 52), without=["centre"])


def test_terms_add_up_and_a_new_model_has_no_oculomotor_biases(model, maps):
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


def test_weights_of_other_layers_are_refused(model):
    other = FixationDensity({"fine": 5, "coarse": 3}, readouts=2, units=4, centre=torch.zeros(4, 5))
    refused("layers", other.load_state_dict, model.state_dict())


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
