"""One table of looks for many scenes, with episodes that start and end, against a loop in each scene."""

import pytest
import torch

from semfov import Detections, Grid
from semfov.belief import DirichletBelief, TargetEvidence
from semfov.belief.observers import Semantic, Target
from semfov.envs.cells import _SceneLooks
from semfov.episode import Memory, StoredLooks, attend, rollout
from semfov.gaze import Given
from semfov.gaze.acquisition import Uniform
from tests.small import tensors

SIZES = [(90, 60), (60, 80), (120, 30)]
CELLS = 6
TARGETS = [[1, 3], [2], [1, 2]]


def stored(scene, dtype):
    """Detections from every cell of a scene; their number differs between scenes, and some cells have none."""
    generator = torch.Generator().manual_seed(scene)
    most = 2 + scene
    size = torch.tensor(SIZES[scene], dtype=torch.float64)
    corner = torch.rand(CELLS, most, 2, generator=generator, dtype=torch.float64) * size * 0.7
    boxes = torch.cat([corner, corner + 2 + size * 0.3 * torch.rand(CELLS, most, 2, generator=generator)], -1)
    scores = (3 * torch.rand(CELLS, most, 4, generator=generator, dtype=torch.float64)).softmax(-1)
    mask = torch.arange(most) < torch.randint(most + 1, (CELLS, 1), generator=generator)
    seen = Detections(boxes.to(dtype), scores.to(dtype), mask)
    return StoredLooks(seen, Grid(3, 2, SIZES[scene]), torch.tensor(TARGETS[scene]))


def evidence(dtype):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return TargetEvidence(6, 5).to(dtype).eval().requires_grad_(False)


OBSERVERS = {
    "map": lambda dtype: Semantic(4),
    "soft": lambda dtype: Semantic(4, footprint="soft", tempering=0.5, memory="closest"),
    "target": lambda dtype: Target(evidence(dtype)),
}


@pytest.mark.parametrize("kind", OBSERVERS)
def test_episodes_in_many_scenes_equal_each_episode_run_alone(kind, dtype):
    """Halfway, two episodes move to other scenes, one of which is new and has more detections per look."""
    observer = OBSERVERS[kind](dtype)
    looks = _SceneLooks(lambda scene: stored(scene, dtype), observer, 4)
    paths = torch.tensor([[0, 4, 2, 1], [5, 1, 0, 3], [3, 2, 4, 5], [1, 0, 5, 2]])
    places = [(0, 1), (1, 2), (0, 3), (1, 2)]
    rows = torch.arange(4)

    def look(memory, rows, turn):
        sight, memory = attend(looks, observer, memory, rows, paths[rows, turn], torch.zeros(len(rows), 2))
        return sight, memory

    def enter(rows):
        chosen = [places[row] for row in rows.tolist()]
        looks.enter(rows, [scene for scene, _ in chosen], torch.tensor([target for _, target in chosen]))
        return Memory.empty(looks, observer, len(rows))

    memory = look(enter(rows), rows, 0)[1]
    memory = look(memory, rows, 1)[1]
    places[1], places[2] = (2, 2), (2, 1)
    some = torch.tensor([1, 2])
    memory = memory.put(some, look(enter(some), some, 0)[1])
    others = torch.tensor([0, 3])
    memory = memory.put(others, look(memory[others], others, 2)[1])
    sight, memory = look(memory, rows, 3)
    for row, (scene, target) in enumerate(places):
        turns = [0, 3] if row in (1, 2) else [0, 1, 2, 3]
        path, own = paths[row, turns][None], stored(scene, dtype)
        own = StoredLooks(own.detections, own.grid, torch.tensor([target]))
        *_, last = rollout(own, observer, Uniform(), path[:, 0], Given(path), most=len(turns))
        assert torch.equal(memory.visited[row], last.visited[0])
        for mine, theirs in zip(tensors(memory.belief), tensors(last.belief), strict=True):
            assert torch.equal(mine[row], theirs[0])
        seen, expected = sight.detections()[row : row + 1], last.detections
        count = int(expected.count)
        assert int(seen.count) == count
        assert torch.equal(seen.boxes[0, :count], expected.boxes[0, expected.mask[0]])


def test_put_changes_only_the_given_rows_and_not_the_original_belief():
    before = DirichletBelief(torch.rand(4, 6, 3) + 1, torch.rand(4, 6))
    other = DirichletBelief(torch.rand(2, 6, 3) + 3, torch.rand(2, 6))
    kept = before.beta.clone()
    after = before.put(torch.tensor([3, 0]), other)
    assert torch.equal(before.beta, kept)
    for row, source in ((3, other[0:1]), (0, other[1:2]), (1, before[1:2]), (2, before[2:3])):
        assert torch.equal(after.beta[row], source.beta[0])
        assert torch.equal(after.closest[row], source.closest[0])
