"""Functions and observers in a user's code: `vmap`, gradients and state.

The tests of every public module are in `tests/base_tester.py`.
"""

import pytest
import torch
from torch import Tensor

import semfov
from semfov.gaze import select_fixation
from tests.small import model, rand


def test_vmap_of_the_choice_equals_a_loop():
    values, noise = rand(5, 2, 12), rand(5, 2, 12).flip(-1)
    visited = noise > 0.8
    expected = torch.stack([select_fixation(*each) for each in zip(values, visited, noise, strict=True)])
    assert torch.equal(torch.func.vmap(select_fixation)(values, visited, noise), expected)


def test_vmap_of_gradients_equals_a_loop():
    """`vmap(grad(...))` as used for influence functions and per-sample gradient clipping."""
    observation = model().requires_grad_(False)
    scores, distance = rand(7, 4).softmax(-1), rand(7)

    def surprise(one: Tensor, eccentricity: Tensor) -> Tensor:
        return -observation(one, eccentricity)[2].log()

    every = torch.func.vmap(torch.func.grad(surprise))(scores, distance)
    for one, eccentricity, gradient in zip(scores, distance, every, strict=True):
        one = one.clone().requires_grad_()
        torch.testing.assert_close(torch.autograd.grad(surprise(one, eccentricity), one)[0], gradient)


@pytest.mark.parametrize("size", [(48, 64), (200, 300)])
@pytest.mark.parametrize("which", ["image", "gaze", "sigma"])
def test_vmap_of_the_sensor_equals_a_loop(size, which):
    given = {"image": rand(1, 3, *size), "gaze": torch.tensor([20.0, 30.0]), "sigma": torch.tensor(9.0)}
    many = {"image": rand(4, 1, 3, *size), "gaze": 40 * rand(5, 2), "sigma": 1 + 9 * rand(5)}[which]

    def view(one: Tensor) -> Tensor:
        options = given | {which: one}
        return semfov.foveate(options["image"], options["gaze"], sigma=options["sigma"])

    torch.testing.assert_close(torch.func.vmap(view)(many), torch.stack([view(one) for one in many]))
