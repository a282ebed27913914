"""The distance of pictures from those of a fit, against the Mahalanobis distance of its covariance."""

import numpy as np
import pytest
import torch

from semfov import Detections
from semfov.detection import FeatureMaps, Placement
from semfov.gaze.saliency import FixationDensity, PictureLikeness
from semfov.gaze.saliency.likeness import FEWEST, pooled
from tests.refusals import refused, unusable
from tests.small import rand


@pytest.fixture
def values() -> torch.Tensor:
    """Correlated values of 200 pictures."""
    generator = torch.Generator().manual_seed(0)
    mixing = torch.randn(6, 6, generator=generator)
    return torch.randn(200, 6, generator=generator) @ mixing + 3


def test_the_distance_is_that_of_the_shrunk_covariance(values: torch.Tensor) -> None:
    """Twin: the covariance as a matrix, its small eigenvalues replaced by their mean, and its inverse."""
    likeness = PictureLikeness.fitted(values, axes=2)
    x = values.double().numpy()
    standard = (x - x.mean(0)) / x.std(0)
    variances, directions = np.linalg.eigh(standard.T @ standard / len(x))
    variances[:4] = variances[:4].mean()
    inverse = np.linalg.inv(directions @ np.diag(variances) @ directions.T)
    expected = np.einsum("ni,ij,nj->n", standard, inverse, standard) / 6 / float(likeness.limit)
    np.testing.assert_allclose(likeness(values).numpy(), expected, rtol=1e-4)


def test_the_limit_calls_such_pictures_alike(values: torch.Tensor) -> None:
    """Each half is measured by the distance that is fitted to the other."""
    likeness = PictureLikeness.fitted(values, axes=2, alike=0.9)
    limits = []
    for one, other in ((values[::2], values[1::2]), (values[1::2], values[::2])):
        half = PictureLikeness.fitted(one, axes=2)
        limits.append(float((half(other) * half.limit).quantile(0.9)))
    assert float(likeness.limit) == pytest.approx(np.mean(limits), rel=1e-5)
    assert 0.85 < float((likeness(values) <= 1).float().mean()) < 0.97
    assert bool((likeness(values + 30 * values.std(0)) > 1).all())


def test_pooled_values_are_of_the_picture_alone() -> None:
    """What a letterbox adds around the picture does not count."""
    maps = {"a": rand(1, 2, 8, 8), "b": rand(1, 3, 4, 4)}
    placement = Placement((80, 40), (0.8, 0.8), (0.0, 16.0))  # the rows from 16 to 48 of a canvas of 64
    features = FeatureMaps(maps, (64, 64), placement, Detections.empty(1, 0))
    rows = {"a": slice(1, 7), "b": slice(0, 4)}  # with the rows that an interpolation at its edges reads
    expected = []
    for name, each in maps.items():
        part = each[0, :, rows[name]].double().flatten(1).numpy()
        expected += [part.mean(1), np.log(part.std(1))]
    np.testing.assert_allclose(pooled(features, ["a", "b"])[0].numpy(), np.concatenate(expected), rtol=1e-4)
    flat = FeatureMaps({"a": torch.ones(1, 2, 8, 8)}, (64, 64), placement, Detections.empty(1, 0))
    assert bool(pooled(flat, ["a"]).isfinite().all())


def test_few_pictures_and_other_values_are_refused(values: torch.Tensor) -> None:
    refused(f"at least {FEWEST} pictures", PictureLikeness.fitted, values[: FEWEST - 1])
    refused(r"values.*\(\*, 6\)|values: expected", PictureLikeness.fitted(values), rand(1, 5))


def test_a_model_keeps_it_in_its_file(values: torch.Tensor, tmp_path) -> None:
    model = FixationDensity({"fine": 3})
    model.save(tmp_path / "old.safetensors")
    assert FixationDensity.from_pretrained(tmp_path / "old.safetensors").likeness is None
    model.likeness = PictureLikeness.fitted(values)
    model.save(tmp_path / "new.safetensors")
    read = FixationDensity.from_pretrained(tmp_path / "new.safetensors").likeness
    assert read is not None
    torch.testing.assert_close(read(values), model.likeness(values))
    model.likeness.deviation = torch.zeros(6)
    model.save(tmp_path / "broken.safetensors")
    unusable("likeness.deviation", FixationDensity.from_pretrained, tmp_path / "broken.safetensors")


@pytest.mark.parametrize("name", ["yolox-nano", "yolov3-tiny", "nanodet-plus-m-1.5x"])
def test_shipped_models_know_the_pictures_of_their_fit(name: str) -> None:
    model = FixationDensity.from_pretrained(name)
    assert model.likeness is not None
    assert len(model.likeness.mean) == 2 * sum(model.layers.values())
    assert float(model.likeness(model.likeness.mean[None])) == 0
