"""Rollouts against a loop over scalars; live and stored looks, gradients, replay and timing."""

import math
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from semfov import Detections, Eye, FovealObservationModel, Foveation, Grid, Selection
from semfov.belief.observers import Semantic, SemanticSearch
from semfov.episode import STAGES, EpisodeLook, LiveLooks, Looks, StoredLooks, rollout
from semfov.gaze import Given, Greedy, Relaxed, soft_fixation
from semfov.gaze.acquisition import AcquisitionFunction, Static, TargetPosterior, Uniform
from semfov.gaze.choice import drawn_from
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from tests.small import Coloured, tensors

GRID = Grid(3, 2, (90, 60))
CELLS = len(GRID)
TARGETS = torch.tensor([1, 3, 1, 2, 3])
START = torch.tensor([0, 4, 2, 2, 5])
BATCH = len(START)
# The cell where each episode ends: one episode ends where it starts, and one never ends.
GOAL = torch.tensor([3, 4, 0, -1, 1])


def rand(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


NOISE = rand(BATCH, CELLS + 1, CELLS, seed=9)


def stored(classes=3, most=4, dtype=torch.float64):
    """Detections from every cell, partly padding; from one cell there are none."""
    corner = rand(CELLS, most, 2) * 50
    boxes = torch.cat([corner, corner + 4 + 30 * rand(CELLS, most, 2, seed=1)], -1)
    scores = (3 * rand(CELLS, most, classes + 1, seed=2)).softmax(-1)
    count = torch.tensor([most, 1, 0, 2, most - 1, 3])
    return Detections(boxes.to(dtype), scores.to(dtype), torch.arange(most) < count[:, None])


def searching(classes=3):
    """An observer of searches, with an observation model that is not trained."""
    names = [f"class {number}" for number in range(1, classes + 1)]
    odds = 0.05 + 0.3 * rand(classes + 1, 2, seed=4).float()
    presence = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((classes,), 0.5))
    model = FovealObservationModel.identity(names, [0.4], miss_odds=odds, refutation=0.6, presence=presence)
    return SemanticSearch(model.eval().requires_grad_(False))


def reached(step):
    return step.cell == GOAL[step.episodes]


def by_target(episodes, cell):
    return TargetPosterior(TARGETS[episodes])


def records(steps):
    """The records of every episode, step by step."""
    episodes = [[] for _ in range(BATCH)]
    for number, step in enumerate(steps):
        assert step.shift == number
        for row, episode in enumerate(step.episodes.tolist()):
            assert len(episodes[episode]) == number
            episodes[episode].append(
                {
                    "cell": int(step.cell[row]),
                    "fixation": step.fixation[row],
                    "present": step.belief.probability(TARGETS[step.episodes])[row],
                    "closest": step.belief.closest[row],
                    "values": step.values[row],
                    "visited": step.visited[row],
                    "next": int(step.next_cell[row]),
                    "next point": step.next_fixation[row],
                    "seen": int(step.detections.count[row]),
                }
            )
    return episodes


class SemanticLoop:
    """The published belief update of one episode in Python floats, with the option `tempering` of `Semantic`."""

    def __init__(self, seen, target, tempering=1.0):
        self.seen, self.target, self.tempering = seen, target, tempering
        self.beta = [[0.5] * seen.scores.shape[-1] for _ in range(CELLS)]

    def look(self, at):
        for detection in range(int(self.seen.count[at])):
            likelihood = [score**self.tempering for score in self.seen.scores[at, detection].tolist()]
            left, top, right, bottom = self.seen.boxes[at, detection].tolist()
            for cell in range(CELLS):
                x, y = cell % 3 * 30, cell // 3 * 30
                if left < x + 30 and right > x and top < y + 30 and bottom > y:
                    self.fuse(self.beta[cell], likelihood)

    def fuse(self, beta, likelihood):
        expected = sum(b * s for b, s in zip(beta, likelihood, strict=True))
        least = min(likelihood)
        for k, score in enumerate(likelihood):
            beta[k] *= (1 + score / expected) / (1 + least / expected)

    def present(self):
        return [beta[self.target] / sum(beta) for beta in self.beta]

    chance = present


def away(cell, other):
    """Distance between the centres of two cells, relative to the longer side of the image."""
    return math.hypot(cell % 3 - other % 3, cell // 3 - other // 3) / 3


def scalar_episode(loop, episode, most, values_of=None):
    """Looks, updates and choices of one episode as a plain loop, in the format of `records`."""
    visited, path, at = [], [], int(START[episode])
    while True:
        loop.look(at)
        visited.append(at)
        values = loop.chance() if values_of is None else values_of
        left = [cell for cell in range(CELLS) if cell not in visited]
        chosen = None
        if left:
            best = max(values[cell] for cell in left)
            tied = [cell for cell in left if values[cell] >= best - 1e-6 * abs(best)]
            chosen = max(tied, key=NOISE[episode, len(path)].tolist().__getitem__)
        path.append((at, loop.present(), values, list(visited), chosen))
        if chosen is None or at == int(GOAL[episode]) or len(path) == most:
            return path
        at = chosen


def check_against_loop(observer, make_loop, acquisition, most, values_of=None):
    seen = stored()
    looks = StoredLooks(seen, GRID, TARGETS)
    steps = rollout(looks, observer, acquisition, START, Greedy(drawn_from(NOISE)), most=most, ends=reached)
    found = records(steps)
    lengths = set()
    for episode in range(BATCH):
        expected = scalar_episode(make_loop(seen, int(TARGETS[episode])), episode, most, values_of)
        lengths.add(len(expected))
        assert len(found[episode]) == len(expected)
        for step, (at, present, values, visited, chosen) in zip(found[episode], expected, strict=True):
            assert step["cell"] == at
            assert torch.equal(step["fixation"], GRID.centres[at].double())
            assert step["present"].tolist() == pytest.approx(present, rel=1e-6)
            assert step["values"].tolist() == pytest.approx(values, rel=1e-6)
            assert step["visited"].nonzero()[:, 0].tolist() == sorted(visited)
            assert step["closest"].tolist() == pytest.approx([min(away(c, v) for v in visited) for c in range(CELLS)])
            assert step["seen"] == int(seen.count[at])
            if chosen is not None:
                assert step["next"] == chosen
                assert torch.equal(step["next point"], GRID.centres[chosen].double())
    if most > 2:
        assert len(lengths) > 1  # The episodes end at different times.


MOST = [1, 3, CELLS, 50]


@pytest.mark.parametrize("most", MOST)
@pytest.mark.parametrize("tempering", [1.0, 0.25])
def test_searches_with_a_semantic_map_equal_the_scalar_loop(most, tempering):
    observer = Semantic(4, tempering=tempering)
    check_against_loop(observer, partial(SemanticLoop, tempering=tempering), by_target, most)


@pytest.mark.parametrize("most", MOST)
@pytest.mark.parametrize("values", [[0.0] * CELLS, [0.3, 0.9, 0.9, 0.1, 0.9, 0.3]], ids=["all tied", "some tied"])
def test_ties_are_broken_by_the_noise_of_each_episode(most, values):
    acquisition = Static(torch.tensor(values, dtype=torch.float64))
    check_against_loop(Semantic(4), SemanticLoop, acquisition, most, values)


def test_without_episodes_or_looks_there_is_no_step():
    looks, choice = StoredLooks(stored(), GRID), Greedy(drawn_from(NOISE))
    assert not list(rollout(looks, Semantic(4), Uniform(), START[:0], choice, most=3))
    assert not list(rollout(looks, Semantic(4), Uniform(), START, choice, most=0))


def test_the_acquisition_is_made_for_the_episodes_that_are_not_over():
    asked = []

    def acquire(episodes, cell):
        asked.append((episodes.tolist(), cell.tolist()))
        return by_target(episodes, cell)

    looks = StoredLooks(stored(), GRID, TARGETS)
    choice = Greedy(drawn_from(NOISE))
    steps = list(rollout(looks, Semantic(4), acquire, START, choice, most=4, ends=reached))
    assert asked == [(step.episodes.tolist(), step.cell.tolist()) for step in steps]
    assert len({len(step.episodes) for step in steps}) > 1


def test_choices_get_the_number_of_the_shift_and_the_episodes():
    asked = []

    class Noted(Greedy):
        def __call__(self, shift, episodes, values, visited, centres):
            asked.append((shift, episodes.tolist(), tuple(values.shape), tuple(visited.shape), tuple(centres.shape)))
            return super().__call__(shift, episodes, values, visited, centres)

    looks = StoredLooks(stored(), GRID, TARGETS)
    steps = list(rollout(looks, Semantic(4), by_target, START, Noted(drawn_from(NOISE)), most=4, ends=reached))
    assert asked == [
        (step.shift, step.episodes.tolist(), (len(step.episodes), CELLS), (len(step.episodes), CELLS), (CELLS, 2))
        for step in steps
    ]


def test_stored_looks_are_weighed_only_once_by_each_observer_and_target():
    class Counted(Semantic):
        weighed = 0

        def weigh(self, *arguments):
            self.weighed += 1
            return super().weigh(*arguments)

    class CountedByTarget(Semantic):
        by_target = True
        asked = ()

        def weigh(self, detections, fixation, grid, target=None):
            self.asked = (*self.asked, target)
            return super().weigh(detections, fixation, grid, target)

    looks = StoredLooks(stored(), GRID, TARGETS)
    mapper, seeker = Counted(4), CountedByTarget(4)
    for observer in (mapper, seeker):
        list(rollout(looks, observer, by_target, START, Greedy(drawn_from(NOISE)), most=4))
    assert mapper.weighed == 1
    assert seeker.asked == (1, 2, 3)
    list(rollout(looks.of(slice(0, 2)), mapper, by_target, START[:2], Greedy(drawn_from(NOISE)), most=2))
    assert mapper.weighed == 1


def live():
    eye = Eye(
        Foveation(8.0), Coloured(("red", "green", "blue"), (96, 64), selection=Selection(threshold=0.3)), reference=90.0
    )
    picture = 0.1 + 0.1 * rand(1, 3, 60, 90).float()
    for channel, (x, y) in enumerate([(20, 10), (70, 40), (75, 8)]):
        picture[0, channel, y : y + 6, x : x + 6] = 0.9
    return eye, eye.open(picture)


@pytest.mark.parametrize("kind", ["map", "search"])
@pytest.mark.parametrize("target", [1, 3])
def test_live_and_stored_looks_give_the_same_scanpath(kind, target):
    eye, view = live()
    seen = eye.look(view, GRID.centres)
    assert len(set(seen.count.tolist())) > 1  # The number of detections depends on the fixation.
    observer = {"map": Semantic(4, tempering=0.5), "search": searching()}[kind]
    run = partial(
        rollout, observer=observer, acquisition=TargetPosterior(target), start=START, choice=Greedy(drawn_from(NOISE))
    )
    targets = torch.full((BATCH,), target)
    ends = partial(run, ends=reached, most=5)
    paths = [list(ends(looks)) for looks in (LiveLooks(eye, view, GRID, target), StoredLooks(seen, GRID, targets))]
    for one, other in zip(*paths, strict=True):
        for name in ("shift", "episodes", "cell", "fixation", "visited", "next_cell", "next_fixation"):
            assert torch.equal(*(torch.as_tensor(getattr(step, name)) for step in (one, other))), name
        torch.testing.assert_close(one.values, other.values)
        torch.testing.assert_close(one.belief.probability(target), other.belief.probability(target))
        torch.testing.assert_close(one.belief.closest, other.belief.closest)
        for row in range(len(one.episodes)):
            mine, theirs = (step.detections for step in (one, other))
            assert mine.count[row] == theirs.count[row]
            torch.testing.assert_close(mine.boxes[row][mine.mask[row]], theirs.boxes[row][theirs.mask[row]])
            torch.testing.assert_close(mine.scores[row][mine.mask[row]], theirs.scores[row][theirs.mask[row]])


def observed():
    names = [f"class {number}" for number in range(1, 21)]
    alpha = 0.5 + 4 * rand(21, 2, 21) + 3 * torch.eye(21)[:, None]
    return FovealObservationModel(alpha, [0.4], names, miss_rate=0.1 + 0.8 * rand(21, 2)).float().requires_grad_(False)


STRATEGIES = {
    "map, non-predictive": lambda: (Semantic(21), Policy("non-predictive")),
    "map with misses, non-predictive": lambda: (Semantic(21, observed(), misses=observed()), Policy("non-predictive")),
    "soft map, non-predictive": lambda: (Semantic(21, tempering=0.25, footprint="soft"), Policy("non-predictive")),
    "closest look, kl": lambda: (Semantic(21, memory="closest"), Policy("kl", observed())),
    "search, non-predictive": lambda: (searching(20), Policy("non-predictive")),
    "map, random": lambda: (Semantic(21), Policy("random")),
}


@pytest.mark.parametrize("name", STRATEGIES)
def test_an_episode_in_a_batch_equals_the_episode_alone_to_the_bit(name):
    observer, policy = STRATEGIES[name]()
    seen = stored(20, 7, torch.float32)
    targets = torch.tensor([1, 17, 1, 20, 17])
    noise = NOISE.float()

    def run(episodes):
        """Steps of the given episodes, without the other ones."""

        def reached_too(step):
            return step.cell == GOAL[episodes][step.episodes]

        looks, choice = StoredLooks(seen, GRID, targets[episodes]), Greedy(drawn_from(noise[episodes]))
        acquire = lambda going, cell: policy(targets[episodes][going], GRID)  # noqa: E731
        return list(rollout(looks, observer, acquire, START[episodes], choice, most=5, ends=reached_too))

    together = run(torch.arange(BATCH))
    assert {len(step.episodes) for step in together} != {BATCH}
    for episode in range(BATCH):
        alone = run(torch.tensor([episode]))
        shared = [(step, step.episodes.tolist().index(episode)) for step in together if episode in step.episodes]
        for one, (step, row) in zip(alone, shared, strict=True):
            for field in ("cell", "fixation", "visited", "values", "next_cell", "next_fixation"):
                assert torch.equal(getattr(one, field)[0], getattr(step, field)[row]), field
            for mine, theirs in zip(tensors(one.belief), tensors(step.belief), strict=True):
                assert torch.equal(mine[0], theirs[row])


# Detections that are differentiable with respect to the fixation.


class Smooth(Looks):
    """Looks at two boxes whose scores are smooth functions of the fixation point."""

    def __init__(self):
        self.grid, self.like = GRID, torch.empty(0, dtype=torch.float64)

    def seen(self, fixation):
        boxes = torch.tensor([[2.0, 2, 55, 28], [40, 20, 88, 58]], dtype=torch.float64).expand(len(fixation), 2, 4)
        places = torch.tensor([[20.0, 20], [70, 40], [30, 50]], dtype=torch.float64)
        near = -((fixation[:, None, None] - places) / 40).square().sum(-1)
        scores = (near * torch.tensor([[1.0], [-2.0]], dtype=torch.float64)).softmax(-1)
        return Detections(boxes, scores, torch.ones(len(fixation), 2, dtype=torch.bool))

    def see(self, observer, episodes, cell, fixation):
        seen = self.seen(fixation)
        return EpisodeLook(observer.weigh(seen, fixation, self.grid), lambda: seen, {})


class Biased(AcquisitionFunction):
    """An acquisition function: the log odds of a class plus a parameter for every cell."""

    def __init__(self, bias):
        super().__init__()
        self.bias = bias

    def forward(self, belief, visited):
        return 4 * belief.probability(1).log() + self.bias


def relaxed(hard):
    return Relaxed(drawn_from(NOISE), GRID.cell_of, temperature=0.8, hard=hard)


def relaxed_steps(bias, hard, most, window=None):
    return list(rollout(Smooth(), Semantic(3), Biased(bias), START[:2], relaxed(hard), most=most, window=window))


def test_soft_choices_pass_gradients_through_all_looks():
    def believed(bias):
        return [step.belief.probability(1) for step in relaxed_steps(bias, hard=False, most=4)]

    bias = rand(CELLS, seed=5).requires_grad_()
    assert torch.autograd.gradcheck(lambda given: torch.stack(believed(given)), bias)
    # The first look comes before any choice; the gradient reaches every later look.
    for shift, present in enumerate(believed(bias)):
        assert present.requires_grad == (shift > 0)
        if shift:
            (gradient,) = torch.autograd.grad(present.square().sum(), bias, retain_graph=True)
            assert gradient.abs().max() > 1e-6


def test_hard_choices_are_cell_centres_with_the_gradient_of_the_soft_point():
    bias = rand(CELLS, seed=5).requires_grad_()
    first, second = relaxed_steps(bias, hard=True, most=2)
    assert torch.equal(second.fixation.detach(), GRID.centres[second.cell].double())
    assert torch.equal(first.next_cell, second.cell)
    (got,) = torch.autograd.grad(second.belief.probability(1).square().sum(), bias)
    # The chain rule: from the loss to the fixation, and from the soft point to the parameters.
    observer, point = Semantic(3), GRID.centres[second.cell].double().requires_grad_()
    after = observer(first.belief.detach(), Smooth().seen(point), point, GRID)
    (slope,) = torch.autograd.grad(after.probability(1).square().sum(), point)
    values = Biased(bias)(first.belief.detach(), first.visited)
    soft, _ = soft_fixation(values, first.visited, GRID.centres.double(), NOISE[:2, 0], temperature=0.8, hard=False)
    (expected,) = torch.autograd.grad(soft, bias, slope)
    torch.testing.assert_close(got, expected)
    assert got.abs().max() > 1e-6


@pytest.mark.parametrize("hard", [True, False])
@pytest.mark.parametrize(("window", "reached_at"), [(None, "-++++"), (1, "-----"), (2, "-+-+-"), (3, "-++-+")])
def test_a_window_truncates_the_gradient_and_changes_no_value(window, reached_at, hard):
    bias = rand(CELLS, seed=5).requires_grad_()
    whole, steps = (relaxed_steps(bias, hard, 5, each) for each in (None, window))
    assert "".join("-+"[step.belief.beta.requires_grad] for step in steps) == reached_at
    assert all(step.next_fixation.requires_grad for step in steps)  # The gradient of a choice within its step is kept.
    for one, other in zip(whole, steps, strict=True):
        for name in ("cell", "fixation", "visited", "values", "next_fixation"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
        assert torch.equal(one.belief.beta, other.belief.beta)


def test_gradients_after_the_border_of_a_window_treat_the_state_as_constant():
    bias = rand(CELLS, seed=5).requires_grad_()
    steps = relaxed_steps(bias, hard=False, most=4, window=2)
    (got,) = torch.autograd.grad(steps[3].belief.probability(1).square().sum(), bias)
    # The same steps from the border between the second look and the third; belief and point are constants there.
    observer, before, point = Semantic(3), steps[1].belief.detach(), steps[1].next_fixation.detach()
    third = observer(before, Smooth().seen(point), point, GRID)
    assert torch.equal(third.beta, steps[2].belief.beta)
    values = Biased(bias)(third, steps[2].visited)
    point, _ = soft_fixation(values, steps[2].visited, GRID.centres.double(), NOISE[:2, 2], temperature=0.8, hard=False)
    fourth = observer(third, Smooth().seen(point), point, GRID)
    (expected,) = torch.autograd.grad(fourth.probability(1).square().sum(), bias)
    torch.testing.assert_close(got, expected)
    uncut = relaxed_steps(bias, hard=False, most=4)[3].belief.probability(1).square().sum()
    (whole,) = torch.autograd.grad(uncut, bias)
    assert not torch.allclose(got, whole, rtol=1e-3)


def test_the_cell_of_a_soft_point_is_the_cell_that_contains_it():
    for step in relaxed_steps(rand(CELLS, seed=5), hard=False, most=4):
        assert torch.equal(step.next_cell, GRID.cell_of(step.next_fixation))
        assert not any(bool((GRID.centres == point.float()).all(-1).any()) for point in step.next_fixation)


@pytest.mark.parametrize("kind", ["map", "search"])
def test_a_recorded_scanpath_is_replayed_to_the_bit(kind):
    observer = Semantic(4) if kind == "map" else searching().double()
    looks = StoredLooks(stored(), GRID, TARGETS)
    run = partial(rollout, looks, observer, by_target, START)
    first = list(run(Greedy(drawn_from(NOISE)), most=5, ends=reached))
    lengths = torch.tensor([sum(episode in step.episodes for step in first) for episode in range(BATCH)])
    assert len(set(lengths.tolist())) > 1
    cells = torch.zeros(BATCH, len(first), dtype=torch.long)
    for step in first:
        cells[step.episodes, step.shift] = step.cell
    again = list(run(Given(cells), most=5, ends=lambda step: step.shift + 1 == lengths[step.episodes]))
    for one, other in zip(first, again, strict=True):
        for name in ("episodes", "cell", "fixation", "visited", "values"):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
        for mine, theirs in zip(tensors(one.belief), tensors(other.belief), strict=True):
            assert torch.equal(mine, theirs)


def test_stored_looks_of_some_episodes_are_those_of_a_source_for_them_alone():
    looks, observer = StoredLooks(stored(), GRID, TARGETS), searching().double()
    for episodes in (torch.tensor([2, 0]), slice(1, 2)):
        sources = looks.of(episodes), StoredLooks(stored(), GRID, TARGETS[episodes])
        some, alone = (
            list(rollout(source, observer, Uniform(), START[episodes], Greedy(drawn_from(NOISE)), most=3))
            for source in sources
        )
        assert torch.equal(sources[0].targets, TARGETS[episodes])
        for one, other in zip(some, alone, strict=True):
            assert torch.equal(one.belief.beta, other.belief.beta)
    assert StoredLooks(stored(), GRID).of(slice(0, 1)).targets is None


def test_a_given_scanpath_may_revisit_cells_and_repeats_its_last_cell():
    """A given scanpath may return to a cell; after its end the gaze stays at the last cell."""
    cells = torch.tensor([[0, 3, 0], [4, 4, 1]])
    looks = StoredLooks(stored(), GRID)
    steps = list(rollout(looks, Semantic(4), Uniform(), cells[:, 0], Given(cells), most=5))
    assert torch.stack([step.cell for step in steps], 1).tolist() == [[0, 3, 0, 0, 0], [4, 4, 1, 1, 1]]
    assert steps[-1].visited.sum(-1).tolist() == [2, 2]


def test_only_the_stages_of_a_cycle_are_timed(monkeypatch):
    """The clock of this test advances only while a stage runs."""
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr("semfov.episode.stopwatch.time", SimpleNamespace(perf_counter=lambda: clock.now))

    def taking(seconds, work):
        def slow(*arguments, **options):
            clock.now += seconds
            return work(*arguments, **options)

        return slow

    eye, view = live()
    observer, choice = Semantic(4), taking(16, Greedy(drawn_from(NOISE)))
    spent = {"foveate": 1.0, "detect": 2.0, "weigh": 4.0, "update belief": 8.0, "choose": 16.0 + 32.0}
    assert tuple(spent) == STAGES
    acquire = taking(32, by_target)
    observer.weigh, observer.update = taking(4, observer.weigh), taking(8, observer.update)
    seen = eye.look(view, GRID.centres)
    eye.sensor.look = taking(1, eye.sensor.look)
    eye.detector.detect = taking(2, eye.detector.detect)
    for step in rollout(LiveLooks(eye, view, GRID), observer, acquire, START, choice, most=3):
        assert step.seconds == spent
        clock.now += 1000.0  # Time that the caller spends between steps does not count.
    # Stored looks are not foveated or detected again, and the first look weighs them all.
    rows = [step.seconds for step in rollout(StoredLooks(seen, GRID), observer, acquire, START, choice, most=3)]
    rest = {stage: spent[stage] for stage in STAGES[2:]}
    assert rows == [rest, rest | {"weigh": 0.0}, rest | {"weigh": 0.0}]


@pytest.mark.parametrize("kind", ["map", "search"])
def test_beliefs_have_the_device_and_dtype_of_the_looks(kind, dtype, device):
    """Beliefs, values and fixations follow the detections."""
    seen = stored(dtype=dtype)
    seen = Detections(seen.boxes.to(device), seen.scores.to(device), seen.mask.to(device))
    observer, targets = Semantic(4) if kind == "map" else searching().to(device, dtype), TARGETS.to(device)
    looks, choice = StoredLooks(seen, GRID, targets), Greedy(drawn_from(NOISE.to(device, dtype)))
    acquire = lambda episodes, cell: TargetPosterior(targets[episodes])  # noqa: E731
    for step in rollout(looks, observer, acquire, START.to(device), choice, most=3):
        for tensor in (step.values, step.fixation, step.next_fixation, step.belief.probability(targets)):
            assert tensor.dtype == dtype
            assert tensor.device.type == device.type
