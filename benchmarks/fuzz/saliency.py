"""Fuzz saliency with images of any shape and grids with more cells than pixels."""

import torch
from hypothesis import strategies as st

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov.gaze.saliency import cell_saliency, itti_koch_saliency, vocus2_saliency


def saliency_maps(data: st.DataObject) -> str:
    """Both models and `cell_saliency`: finite values in [0, 1], all 0 for a uniform image; or `InputError`."""
    rng = draw_rng(data)
    height, width = data.draw(st.integers(0, 40), label="height"), data.draw(st.integers(0, 70), label="width")
    channels = choose(data, (3, 3, 3, 1), "channels")
    kind = choose(data, ("random", "flat", "spot", "bytes"), "kind")
    image = torch.from_numpy(rng.random((1, channels, height, width))).float()
    if kind == "flat":
        image = torch.full_like(image, 0.3)
    if kind == "spot" and image.numel():
        image = torch.zeros_like(image)
        image[0, :, rng.integers(height), rng.integers(width)] = 1
    if kind == "bytes":
        image = (image * 255).byte()
    model = choose(data, (vocus2_saliency, itti_koch_saliency), "model")
    columns, rows = data.draw(st.integers(0, 12), label="columns"), data.draw(st.integers(0, 12), label="rows")
    reduction = choose(data, ("mean", "max"), "reduction")
    result = attempt(lambda: cell_saliency(model(image), columns, rows, reduction))
    bad = channels != 3 or kind == "bytes" or height * width * columns * rows == 0
    if failed(result):
        assert bad, result
        return outcome(result)
    assert not bad
    assert isinstance(result, torch.Tensor)
    assert result.shape == (1, columns * rows)
    assert bool(((result >= 0) & (result <= 1 + 1e-6)).all())
    if kind == "flat":
        assert not result.any()
    return "result"
