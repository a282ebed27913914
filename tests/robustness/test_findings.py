"""Errors that fuzzing found, each as a minimal case."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from semfov import FovealObservationModel, Grid, acquisition, read_image
from semfov.io.storage import read_tensors, write_tensors
from tests.refusals import refused


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("oriented", [True, False])
def test_grey_tiffs_are_rotated_only_once(tmp_path, orientation, oriented):
    """Pillow rotates TIFFs while it loads them, and mixes up rows of TIFFs that it maps into memory."""
    pixels = np.arange(6, dtype=np.uint8).reshape(2, 3) * 40
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(tmp_path / "image.tiff", exif=exif)
    Image.fromarray(pixels).convert("RGB").save(tmp_path / "image.png", exif=exif)
    expected = read_image(tmp_path / "image.png", oriented=oriented)
    torch.testing.assert_close(read_image(tmp_path / "image.tiff", oriented=oriented), expected)
    if not oriented:
        assert expected.shape == (3, 2, 3)


def test_points_and_boxes_far_outside_are_in_the_grid():
    assert Grid(3, 2, (30, 20)).cell_of(torch.tensor([[1e30, 5.0], [-1e30, 5.0]])).tolist() == [2, 0]
    weights = Grid(3, 2, (30, 20)).footprint(torch.tensor([[-1e30, -1e30, 1e30, 1e30]]), "soft")
    torch.testing.assert_close(weights, torch.ones(1, 6))


@pytest.mark.parametrize("distance", [math.nan, -0.1])
def test_invalid_distances_are_refused(distance):
    """NaN was treated as the outermost level."""
    model = FovealObservationModel.identity(["cup"], [0.2])
    refused("distance: expected numbers from 0 up", model.calibrate, torch.tensor([0.4, 0.6]), torch.tensor(distance))


def test_a_model_that_does_not_fit_on_the_disk_raises_an_error(fresh, tmp_path):
    """`safetensors` raises its own type of error for it; the old file must stay unchanged."""
    path = tmp_path / "model.safetensors"
    FovealObservationModel.identity(["cup"], [0.2]).save(path)
    before = path.read_bytes()
    code = (
        "import resource, semfov\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (600, 600))\n"
        "try:\n"
        f"    semfov.FovealObservationModel.identity([f'class {{n}}' for n in range(40)], [0.2]).save({str(path)!r})\n"
        "except semfov.DataError as error:\n"
        "    print(error)\n"
    )
    assert fresh(code).startswith(f"cannot write {path}: ")
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_tensors_copied_from_another_cache_file_are_ignored(tmp_path):
    first, second = tmp_path / "1.safetensors", tmp_path / "2.safetensors"
    for number, path in enumerate((first, second)):
        write_tensors(path, "key", {"a": torch.full((3,), float(number))})
    assert read_tensors(first, "key")["a"].tolist() == [0, 0, 0]
    first.write_bytes(second.read_bytes())
    assert read_tensors(first, "key") is None


def test_buffers_of_an_acquisition_function_require_no_gradient():
    """Otherwise the function could not be copied."""
    model = FovealObservationModel.identity(["cup"], [0.2], miss_rate=torch.full((2, 2), 0.5))
    assert not any(b.requires_grad for b in acquisition.ExpectedAccuracy(model, Grid(2, 2, (4, 4))).buffers())
