"""Invalid scores and boxes of a detector raise an error, and are not treated as an image without detections."""

import pytest
import torch

from semfov.detection import Candidates
from semfov.errors import DataError, InputError
from tests.small import Fixed


def candidates(**changes):
    made = {
        "boxes": torch.tensor([[[1.0, 1, 9, 9], [10, 10, 20, 20]]]),
        "classes": torch.tensor([[[0.9, 0.1], [0.2, 0.7]]]),
        "objectness": torch.tensor([[0.8, 0.6]]),
    }
    for name, value in changes.items():
        made[name][0, 1] = value
    return Candidates(**made)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"classes": torch.nan}, "confidence.*finite"),
        ({"objectness": torch.nan}, "confidence.*finite"),
        ({"boxes": torch.nan}, "boxes.*finite"),
        ({"boxes": torch.inf}, "boxes.*finite"),
        ({"classes": 1.5}, r"class scores.*\[0, 1\]"),
        ({"objectness": 2.0}, r"objectness.*\[0, 1\]"),
    ],
)
def test_invalid_detections_are_refused(changes, message):
    image = torch.rand(1, 3, 32, 32)
    assert Fixed(candidates=candidates())(image).count.tolist() == [2]
    with pytest.raises(InputError, match=message):
        Fixed(candidates=candidates(**changes))(image)


def test_a_network_with_a_huge_kernel_is_refused():
    from semfov.detection.darknet import Darknet
    from semfov.detection.darknet_config import parse_cfg

    text = "[net]\nwidth=32\nheight=32\n[convolutional]\nfilters=21\nsize=99999\n[yolo]\nmask=0\nanchors=4,6\nclasses=2"
    with pytest.raises(DataError, match="parameters"):
        Darknet(parse_cfg(text))
