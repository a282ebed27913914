"""What a fovea has shown so far, against a loop over pixels."""

import numpy as np
import torch

from semfov.detection import Detections, FeatureMaps, Placement
from semfov.gaze.saliency import features_so_far
from tests.refusals import refused
from tests.small import draw as rand

PLACE = Placement((80, 60), (0.5, 0.5), (2.0, 4.0))
CANVAS = (48, 40)


def views(count=5):
    none = Detections(torch.zeros(count, 0, 4), torch.zeros(count, 0, 1), torch.zeros(count, 0, dtype=torch.bool))
    maps = {"backbone8": rand(count, 3, 5, 6).float(), "head16": rand(count, 2, 3, 3, seed=1).float()}
    return FeatureMaps(maps, CANVAS, PLACE, none)


def test_each_place_has_the_features_of_the_closest_look():
    seen, fixations = views(), torch.from_numpy(np.random.default_rng(0).uniform(0, (79, 59), (5, 2)))
    path = fixations[[3, 1, 4]] + 0.1
    got = features_so_far(seen, fixations, path[None])
    assert got.placement == PLACE
    for name, maps in seen.maps.items():
        height, width = maps.shape[-2:]
        for row in range(height):
            for column in range(width):
                x = ((column + 0.5) * CANVAS[0] / width - 2.0) / 0.5 - 0.5
                y = ((row + 0.5) * CANVAS[1] / height - 4.0) / 0.5 - 0.5
                away = [np.hypot(*(fixations[view].numpy() - (x, y))) for view in (3, 1, 4)]
                expected = maps[(3, 1, 4)[int(np.argmin(away))], :, row, column]
                assert torch.equal(got.maps[name][0, :, row, column], expected)


def test_a_shorter_path_is_as_if_alone():
    seen, fixations = views(), torch.tensor([[5.0, 5], [70, 5], [40, 30], [5, 50], [70, 50]])
    short = torch.full((2, 3, 2), torch.nan)
    short[0], short[1, 2] = fixations[[0, 2, 4]], fixations[1]
    both, alone = features_so_far(seen, fixations, short), features_so_far(seen, fixations, short[1:, 2:])
    for name in seen.maps:
        assert torch.equal(both.maps[name][1], alone.maps[name][0])
        assert torch.equal(both.maps[name][1], seen.maps[name][1])
    refused("scanpath", features_so_far, seen, fixations, torch.full((1, 2, 2), torch.nan))
    refused("fixations", features_so_far, seen, fixations[:3], short)
