"""Learned evidence for a map: log odds, emptiness and gain against numpy, and files."""

import numpy as np
import pytest
import torch

from semfov import Grid, InputError, MapEvidence
from semfov.belief.look_features import class_features
from tests.belief import reference

GRID = Grid(6, 4, (90, 60))


def draw(*shape, seed=3):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_evidence_of_looks_is_the_network_applied_to_their_features(random_looks, toy_map):
    model, looks, fixations = (
        toy_map().double(),
        random_looks(dtype=torch.float64),
        GRID.centres[[0, 9, 20, 5]].double(),
    )
    targets = torch.tensor([4, 1])
    got = model(looks, fixations, GRID, targets)
    assert got.shape == (4, 2, 24)
    features = class_features(looks, fixations, GRID, targets)
    np.testing.assert_allclose(
        reference.array(got), reference.run_network(model.look, reference.array(features)), atol=1e-12
    )


@pytest.mark.parametrize("classes", [2, 4])
@pytest.mark.parametrize("columns", [1, 6, 24])
def test_log_odds_of_a_class_depend_on_its_strongest_rival(toy_map, gathered, classes, columns):
    model, said = toy_map().double(), gathered(classes=classes)
    got = model.log_odds(said, columns, classes)
    assert got.shape == (2, classes, 24)
    for episode in range(2):
        rows = slice(episode * classes, (episode + 1) * classes)
        expected = reference.class_odds(
            model,
            *(reference.array(getattr(said, name)[rows]) for name in ("nearest", "best", "mean")),
            reference.array(said.distance[rows][0]),
            float(said.looks[rows][0]),
            said.target[rows].tolist(),
            columns,
        )
        np.testing.assert_allclose(reference.array(got[episode]), expected, atol=1e-6)


REST = ("best", "mean", "distance", "score", "looks", "visited", "target")


def test_classes_with_equal_evidence_are_rivals_of_each_other(toy_map, gathered):
    """So both have the same log odds."""
    model, said = toy_map().double(), gathered(episodes=1, classes=2)
    nearest = said.nearest[:1].expand(2, -1)
    same = [getattr(said, name)[:1].expand(2, *getattr(said, name).shape[1:]) for name in REST]
    odds = model.log_odds(type(said)(nearest, *same), 6, 2)[0]
    torch.testing.assert_close(odds[0], odds[1])


@pytest.mark.parametrize("columns", [1, 6, 24])
@pytest.mark.parametrize("stands_for", [None, [1.0, 1, 9.5, 2]], ids=["all", "some"])
def test_emptiness_equals_numpy(toy_map, columns, stands_for):
    model, odds, distance = toy_map().double(), 2 * draw(2, 4, 24) - 2, draw(2, 24, seed=4).abs() / 3
    looks = torch.tensor([1.0, 7.0], dtype=torch.float64)
    share = None if stands_for is None else torch.tensor([stands_for] * 2).double()
    got = model.emptiness(odds, distance, looks, columns, share)
    assert got.shape == (2, 24)
    for row in range(2):
        expected = reference.emptiness(
            model, reference.array(odds[row]), reference.array(distance[row]), float(looks[row]), columns, stands_for
        )
        np.testing.assert_allclose(reference.array(got[row]), expected, atol=1e-6)


def test_emptiness_is_finite_for_certain_cells():
    """Very large log odds, in float32."""
    model = MapEvidence(4, 4, components=4)
    odds = torch.tensor([-200.0, -40, 0, 40, 200]).expand(1, 3, -1).requires_grad_()
    got = model.emptiness(odds, torch.zeros(1, 5), torch.ones(1), 5)
    assert bool(got.isfinite().all())
    got.sum().backward()


@pytest.mark.parametrize("wide", [False, True], ids=["same for all", "of each"])
def test_gain_equals_a_loop(toy_map, dtype, wide, device):
    model = toy_map().to(device, dtype)
    generator = torch.Generator().manual_seed(0)
    probabilities = torch.rand(3, 24, 5, generator=generator).to(device, dtype)
    closest = torch.rand(3, 24, generator=generator).to(device, dtype) / 2
    looks = torch.tensor([1.0, 4, 9], device=device, dtype=dtype)
    distance = GRID.cell_distance[[3, 8, 17, 20]].to(device, dtype)
    per_episode = torch.stack([distance, 2 * distance, distance.flip(0)])
    got = model.gain(probabilities, closest, looks, per_episode if wide else distance)
    assert got.shape == (3, 4, 24)
    assert got.dtype == dtype
    for episode in range(3):
        for fixation in range(4):
            where = per_episode[episode, fixation] if wide else distance[fixation]
            expected = reference.gain(
                model,
                reference.array(probabilities[episode]),
                reference.array(closest[episode]),
                float(looks[episode]),
                reference.array(where),
            )
            np.testing.assert_allclose(reference.array(got[episode, fixation]), expected, atol=1e-5)


def test_gain_with_two_classes_equals_a_loop(toy_map):
    model, probabilities = toy_map(components=3).double(), draw(1, 24, 3).sigmoid()
    closest, distance = torch.full((1, 24), 0.5, dtype=torch.float64), GRID.cell_distance[[3]].double()
    got = model.gain(probabilities, closest, torch.ones(1).double(), distance)[0, 0]
    expected = reference.gain(model, *map(reference.array, (probabilities[0], closest[0])), 1.0, distance[0].numpy())
    np.testing.assert_allclose(reference.array(got), expected, atol=1e-9)


def test_gain_is_zero_where_the_look_is_not_closer_than_before(toy_map):
    model = toy_map().double()
    probabilities, looks = torch.rand(1, 24, 5).double(), torch.ones(1).double()
    distance = GRID.cell_distance.double()
    closest = distance[[0, 13]].amin(0, keepdim=True)
    got = model.gain(probabilities, closest, looks, distance)[0]
    assert not got[[0, 13]].any()
    assert torch.equal(got != 0, distance < closest)
    assert not model.gain(probabilities, 0 * closest, looks, distance).any()
    # Up to a millionth of the longer side, two distances count as equal.
    for difference, closer in ((1e-6, False), (2e-6, True)):
        got = model.gain(probabilities, torch.full_like(closest, difference), looks, 0 * distance)
        assert bool((got != 0).all()) == closer


def test_sizes_have_defaults_and_limits():
    for name, value in [
        ("look_width", 0),
        ("readout_width", 0),
        ("components", 2),
        ("components", 10_001),
        ("components", 3.0),
    ]:
        with pytest.raises(InputError, match=f"{name}: expected a whole number"):
            MapEvidence(**{name: value})
    for settings, widths, components in [
        ({}, (48, 24), 81),
        ({"look_width": 1, "readout_width": 1, "components": 3}, (1, 1), 3),
        ({"look_width": 1, "readout_width": 1, "components": 10_000}, (1, 1), 10_000),
    ]:
        model = MapEvidence(**settings)
        assert (model.widths, len(model.prior)) == (widths, components)
