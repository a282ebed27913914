"""The sensor and one step of a search as ONNX graphs: results of onnxruntime equal those of torch."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from semfov import DirichletBelief, FovealObservationModel, Foveation, Grid, acquisition, fusion
from semfov.gaze import select_fixation
from semfov.observation import FoldedObservationModel
from semfov.sensor import LogPolar, MultiScaleFovea

ort = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript", reason="torch exports ONNX with it")

pytestmark = pytest.mark.slow

CLASSES = ("cat", "cup", "person")
GRID = Grid(5, 4, (100, 80))


class SearchStep(nn.Module):
    """Fuse the detections of one look and choose the next cell.

    Args:
        observation: calibrates the scores.
        value: the acquisition function.
    """

    def __init__(self, observation: FovealObservationModel, value: nn.Module) -> None:
        super().__init__()
        self.observation = observation
        self.value = value

    def forward(
        self, beta: Tensor, scores: Tensor, distance: Tensor, footprint: Tensor, visited: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        likelihood = self.observation(scores, distance)
        for number in range(likelihood.shape[1]):
            fused = fusion.kaplan(beta, likelihood[:, number, None])
            beta = torch.where(footprint[:, number, :, None], fused, beta)
        values = self.value(DirichletBelief(beta), visited)
        return beta, values, select_fixation(values, visited, noise)


def run(module: nn.Module, inputs: tuple[Tensor, ...], path: Path) -> list[np.ndarray]:
    """Export the module and run it in onnxruntime."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings inside the exporter
        torch.onnx.export(module, inputs, path, dynamo=True, verbose=False, external_data=False)
    session = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [value.name for value in session.get_inputs()]
    return session.run(None, {name: tensor.numpy() for name, tensor in zip(names, inputs, strict=True)})


def seeded(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape)))


@pytest.mark.parametrize(
    ("sensor", "tolerance"),
    [
        (Foveation(15.0, levels=2), 2e-6),
        pytest.param(LogPolar(15.0), 2e-4, marks=pytest.mark.lab),
        pytest.param(MultiScaleFovea(16, 2), 2e-6, marks=pytest.mark.long),
    ],
)
def test_exported_sensor_equals_torch(sensor, tolerance, tmp_path):
    inputs = seeded(1, 3, 48, 64), torch.tensor([[40.2, 30.5]])
    (view,) = run(sensor.eval(), inputs, tmp_path / "sensor.onnx")
    with torch.no_grad():
        np.testing.assert_allclose(view, sensor(*inputs).numpy(), rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", ["predictive", "negative entropy"])
def test_exported_search_step_equals_torch(name, tmp_path):
    alpha = 0.5 + 5 * seeded(4, 3, 4) + 4 * torch.eye(4)[:, None]
    model = FovealObservationModel(alpha, [0.2, 0.5], CLASSES).eval().requires_grad_(False)
    folded = FoldedObservationModel(model)

    def step_with(source: FovealObservationModel) -> SearchStep:
        if name == "predictive":
            value: nn.Module = acquisition.PredictedTargetPosterior(2, source)
        else:
            value = acquisition.NegativeEntropy(source, GRID)
        return SearchStep(source, value).eval()

    cells, looks = len(GRID), 3
    visited = torch.zeros(1, cells, dtype=torch.bool)
    visited[0, 7] = True
    inputs = (
        torch.full((1, cells, 4), 0.5),
        seeded(1, looks, 4) / seeded(1, looks, 4).sum(-1, keepdim=True),
        seeded(1, looks),
        seeded(1, looks, cells) < 0.4,
        visited,
        seeded(1, cells),
    )
    beta, values, cell = run(step_with(folded), inputs, tmp_path / "step.onnx")
    expected = step_with(model)(*inputs)
    np.testing.assert_allclose(beta, expected[0].numpy(), rtol=1e-5)
    np.testing.assert_allclose(values, expected[1].numpy(), rtol=1e-3, atol=1e-6)
    assert cell.tolist() == expected[2].tolist()
    assert beta.max() > 0.5
    assert cell[0] != 7
