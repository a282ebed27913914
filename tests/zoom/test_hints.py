"""Hints of a look, and the gist that keeps the strongest of them."""

import torch

from semfov.detection.detections import Detections
from semfov.detection.scores import Candidates, score_vectors
from semfov.zoom.gist import gist
from semfov.zoom.hints import HINT, hints_of
from semfov.zoom.lattice import Lattice

LATTICE = Lattice.over((256, 192), (64, 64))


def candidates(count=2, boxes=500, classes=3):
    generator = torch.Generator().manual_seed(0)
    low = torch.rand(count, boxes, 2, generator=generator) * 48
    size = torch.rand(count, boxes, 2, generator=generator) * 12 - 1  # some boxes have no area
    scores = torch.rand(count, boxes, classes, generator=generator) ** 8
    return Candidates(torch.cat([low, low + size], -1), scores, torch.rand(count, boxes, generator=generator))


def test_hints_are_all_candidates_that_are_confident_enough_and_have_an_area():
    proposed = candidates()
    seen = hints_of(proposed, "residual")
    counts = []
    for image in range(2):
        wanted = [
            number
            for number, (x1, y1, x2, y2) in enumerate(proposed.boxes[image].tolist())
            if x2 > x1 and y2 > y1 and float(proposed.confidence[image, number]) >= HINT
        ]
        found = seen.boxes[image][seen.mask[image]]
        assert sorted(found.tolist()) == sorted(proposed.boxes[image, wanted].tolist())
        torch.testing.assert_close(
            seen.scores[image][seen.mask[image]].sort(0).values,
            score_vectors(proposed.take(image, torch.tensor(wanted))).sort(0).values,
        )
        counts.append(len(wanted))
    assert 0 < min(counts) < max(counts) < 500


def test_neither_duplicates_nor_their_number_count():
    boxes = torch.tensor([8.0, 8, 24, 24]).expand(1, 2000, 4)
    assert int(hints_of(Candidates(boxes, torch.full((1, 2000, 3), 0.01)), "residual").count) == 2000


def test_the_gist_of_a_cell_has_the_highest_scores_and_the_size_of_the_most_confident_hint():
    """In every order of the hints; compared with a search through them, cell by cell."""
    hints = hints_of(candidates(count=1), "residual")
    nothing = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 4), torch.zeros(1, 0, dtype=torch.bool))
    order = torch.randperm(hints.boxes.shape[1], generator=torch.Generator().manual_seed(1))
    shuffled = Detections(hints.boxes[:, order], hints.scores[:, order], hints.mask[:, order])
    one, other = (gist(some, nothing, LATTICE, (1, 0, 0)) for some in (hints, shuffled))
    assert torch.equal(one.scores, other.scores)
    assert torch.equal(one.size, other.size)
    centres = (hints.boxes[0, :, :2] + hints.boxes[0, :, 2:]) / 2
    wide, high = LATTICE.pitch
    several = 0
    for row, column in ((0, 0), (1, 2), (3, 3), (5, 1)):
        inside = (centres[:, 0] // wide == column) & (centres[:, 1] // high == row)
        several += int(inside.sum()) > 1
        best = hints.scores[0, inside, 1:].amax(0)
        torch.testing.assert_close(one.scores[row, column], best)
        leader = hints.boxes[0, inside][hints.scores[0, inside, 1:].amax(-1).argmax()]
        side = ((leader[2:] - leader[:2]).prod().sqrt() * LATTICE.magnifications[1]).log2().clamp(min=0)
        torch.testing.assert_close(one.size[row, column], side)
    assert several == 4
