"""Policies along given scanpaths: together or one by one, with coarse or fine beliefs."""

import torch

from eval.human.viewing.run import FineLooks, evaluate_along
from semfov import Detections, Grid
from semfov.belief.observers import Landing, Semantic
from semfov.episode import StoredLooks, rollout
from semfov.gaze.choice import Given
from semfov.gaze.policies import Closer, ObjectSeeking
from semfov.runs.candidates import Candidate
from semfov.strategy import Strategy

GRID = Grid(3, 2, (90, 60))


def detections(looks, classes=3, count=4):
    generator = torch.Generator().manual_seed(0)
    corner = torch.rand(looks, count, 2, generator=generator) * 50
    boxes = torch.cat([corner, corner + 5 + torch.rand(looks, count, 2, generator=generator) * 30], -1)
    scores = (4 * torch.rand(looks, count, classes + 1, generator=generator)).softmax(-1)
    return Detections(boxes, scores, torch.rand(looks, count, generator=generator) < 0.8)


def test_following_all_people_and_policies_at_once_equals_following_each_alone():
    paths = [torch.tensor([4, 1, 1, 5]), torch.tensor([0, 2]), torch.tensor([5, 4, 3])]
    seen = detections(6)
    observer = Semantic(4)
    candidates = {
        name: Candidate(Strategy(observer, policy)) for name, policy in (("a", ObjectSeeking()), ("b", Closer()))
    }
    together = evaluate_along(StoredLooks(seen, GRID), candidates, paths)
    for name, candidate in candidates.items():
        expected = []
        for path in paths:
            steps = rollout(
                StoredLooks(seen, GRID),
                observer,
                candidate.acquisition(None, GRID, path[:1]),
                path[:1],
                Given(path[None]),
                most=len(path) - 1,
            )
            expected += [step.values[0] for step in steps]
        torch.testing.assert_close(together[name], torch.stack(expected))


def test_a_fine_belief_uses_looks_from_the_coarse_cell_of_each_fixation():
    fine, seen = Grid(9, 6, (90, 60)), detections(6)
    observer = Landing(3)
    looks = FineLooks(seen, GRID, fine)
    # The bins in the corners of the picture lie in the first and the last cell.
    values = evaluate_along(
        looks, {"landing": Candidate(Strategy(observer, ObjectSeeking()))}, [torch.tensor([0, 53, 10])]
    )["landing"]
    assert values.shape == (2, 54)
    said = observer.weigh(seen, GRID.centres, fine).evidence
    torch.testing.assert_close(values[0], said[0].sum(-1))
    torch.testing.assert_close(values[1], torch.maximum(said[0], said[5]).sum(-1))
