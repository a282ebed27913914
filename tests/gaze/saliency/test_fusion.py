"""Fusion of maps against OpenCV and NumPy."""

import cv2
import numpy as np
import pytest
import torch

from semfov.errors import InputError
from semfov.gaze.saliency.blur import rescale
from semfov.gaze.saliency.vocus2 import _combine_maps


@pytest.mark.parametrize("fusion", ["mean", "max"])
def test_fusion_equals_opencv(fusion: str, dtype: torch.dtype, tolerance: float) -> None:
    sizes = [(24, 37), (12, 18), (6, 9), (3, 4)]
    maps = [torch.rand(2, 6, *size, dtype=dtype) for size in sizes]
    fused = _combine_maps(maps, sizes[0], fusion)
    for image in range(2):
        enlarged = [
            cv2.resize(each.double().numpy(), sizes[0][::-1], interpolation=cv2.INTER_CUBIC)
            for layer in maps
            for each in layer[image]
        ]
        expected = np.mean(enlarged, 0) if fusion == "mean" else np.max(enlarged, 0)
        np.testing.assert_allclose(fused[image].numpy(), expected, atol=tolerance)


def test_rescale(dtype: torch.dtype) -> None:
    maps = torch.randn(2, 3, 5, 7, dtype=dtype)
    maps[1, 2] = 4.0
    result = rescale(maps)
    assert result[1, 2].abs().max() == 0
    steep = result.flatten(0, 1)[:5]
    assert (steep.amin((-2, -1)) == 0).all()
    assert (steep.amax((-2, -1)) == 1).all()
    assert rescale(1e-3 * maps, flat=1.0).abs().max() == 0


def test_gradient_of_a_flat_map_is_finite() -> None:
    flat = torch.ones(1, 3, 4, requires_grad=True)
    rescale(flat).sum().backward()
    assert flat.grad is not None
    assert flat.grad.abs().max() == 0


def test_bad_input() -> None:
    with pytest.raises(InputError, match="maps"):
        _combine_maps([], (4, 4))
    with pytest.raises(InputError, match="maps"):
        _combine_maps([torch.zeros(1, 2, 4, 4), torch.zeros(1, 3, 2, 2)], (4, 4))
    with pytest.raises(InputError, match="fusion"):
        _combine_maps([torch.zeros(1, 2, 4, 4)], (4, 4), "median")
