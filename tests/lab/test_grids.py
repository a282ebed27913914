"""Learned models estimate the presence of a target equally well on finer and coarser grids than in the fit."""

import json
import random

import pytest
import torch

from semfov import ActivePerception, read_image

CASES = 8


@pytest.mark.slow
@pytest.mark.shared
def test_presence_is_estimated_equally_well_on_other_grids(shared):
    """Compare squared errors of the probability of presence, for present and absent targets."""
    records = json.loads((shared / "coco" / "annotations" / "instances_fit.json").read_text(encoding="utf-8"))
    names = {category["id"]: category["name"] for category in records["categories"]}
    held: dict[int, set[str]] = {}
    for annotation in records["annotations"]:
        held.setdefault(annotation["image_id"], set()).add(names[annotation["category_id"]])
    drawn = random.Random(0)
    images = drawn.sample(sorted((image for image in records["images"] if image["id"] in held), key=str), CASES)
    agent = ActivePerception.recommended()
    asked = [
        (shared / "coco" / "fit" / image["file_name"], drawn.choice(sorted(of)), truth)
        for image in images
        for of, truth in ((held[image["id"]], 1.0), (set(agent.classes[1:]) - held[image["id"]], 0.0))
    ]
    errors = {}
    for grid in ((10, 10), (20, 20), (5, 5)):
        agent = ActivePerception.recommended(grid=grid)
        with torch.inference_mode():
            paths = [agent.search(read_image(path), target, shifts=8) for path, target, _ in asked]
        chances = torch.stack([path.presence[-1] for path in paths])
        errors[grid] = float((chances - torch.tensor([truth for _, _, truth in asked])).square().mean())
    assert errors[10, 10] < 0.2, "a constant probability of 0.5 gives 0.25"
    assert errors[20, 20] < errors[10, 10] + 0.04
    assert errors[5, 5] < errors[10, 10] + 0.04
