"""Invalid scores and boxes of a detector raise an error, and are not treated as an image without detections."""

import pytest
import torch

from semfov.detection import Candidates
from semfov.errors import InputError
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
