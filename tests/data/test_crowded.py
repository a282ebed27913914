"""The scenes of a set that hold most objects."""

import pytest
import torch

from semfov.data import EmbeddedScenes
from semfov.data.scene import Crowded
from semfov.errors import InputError


def test_no_scene_that_is_left_out_holds_more_objects_than_one_that_is_kept():
    scenes = EmbeddedScenes(("person", "cat", "dog"), count=9, seed=3)
    crowded = Crowded(scenes, 0.4)
    counts = {name: len(scenes.annotation(index).boxes) for index, name in enumerate(scenes.ids)}
    assert len(crowded) == len(crowded.ids) == 4  # 3.6 rounded up
    assert len(set(counts.values())) > 1
    left = [counts[name] for name in scenes.ids if name not in crowded.ids]
    assert min(counts[name] for name in crowded.ids) >= max(left)
    assert crowded.ids == sorted(crowded.ids)


def test_a_scene_is_that_of_the_set():
    scenes = EmbeddedScenes(("person", "cat", "dog"), count=6, seed=3)
    crowded = Crowded(scenes, 0.5)
    for index, name in enumerate(crowded.ids):
        place = scenes.ids.index(name)
        assert torch.equal(crowded[index].image, scenes[place].image)
        assert torch.equal(crowded.annotation(index).boxes, scenes.annotation(place).boxes)
        assert crowded.targets(index) == scenes.targets(place)
        assert crowded.digest(index) == scenes.digest(place)
    assert crowded.classes == scenes.classes
    assert len({crowded.fingerprint, scenes.fingerprint, Crowded(scenes, 0.3).fingerprint}) == 3


@pytest.mark.parametrize("share", [0.0, -0.1, 1.5, float("nan")])
def test_a_share_outside_its_range_is_refused(share):
    with pytest.raises(InputError, match="share: expected above 0"):
        Crowded(EmbeddedScenes(("person",), count=2), share)
