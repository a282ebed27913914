"""The agent as a whole, with a detector that sees coloured squares."""

import copy

import pytest
import torch

from semfov import ActivePerception, FovealObservationModel, Foveation, Grid, SemanticMap, search_policy
from semfov.agent import confirms, step
from semfov.belief import SemanticObserver, TargetEvidence, TargetObserver
from semfov.detection import Candidates, Detections, Detector
from semfov.errors import InputError
from semfov.eye import Eye
from semfov.gaze import exploration_policy
from semfov.sensor import foveate

SIZE = (160, 120)


class Squares(Detector):
    """Detects the bounding box of what is red (class 1) and what is green (class 2); its score is how saturated."""

    def __init__(self) -> None:
        super().__init__("squares", ("red", "green"), SIZE)

    def propose(self, canvas):
        boxes, classes = [], []
        for channel in (0, 1):
            colour = canvas[0, channel] - canvas[0, 1 - channel]
            ys, xs = (colour > 0.1).nonzero(as_tuple=True)
            if len(xs):
                boxes.append(torch.stack([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]).to(canvas))
                classes.append(torch.nn.functional.one_hot(torch.tensor(channel), 2) * colour.max().clamp(0, 1))
        if not boxes:
            return Candidates(canvas.new_zeros(1, 0, 4), canvas.new_zeros(1, 0, 2))
        return Candidates(torch.stack(boxes)[None], torch.stack(classes)[None])


@pytest.fixture
def image():
    """A red square at the top left and a smaller green one at the bottom right, on grey."""
    picture = torch.full((3, 120, 160), 0.4)
    picture[:, 8:28, 8:28] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    picture[:, 100:110, 130:140] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]
    return picture


@pytest.fixture
def agent():
    return ActivePerception(Foveation(40.0), Squares(), None, (8, 6), search_policy("non-predictive"), reference=160.0)


def test_search_goes_to_the_target(agent, image):
    scanpath = agent.search(image, "green", start=0)
    assert scanpath.found
    assert scanpath.classes[scanpath.target] == "green"
    grid = Grid(8, 6, SIZE)
    goal = grid.footprint(torch.tensor([[130.0, 100, 140, 110]]))[0]
    assert goal[scanpath.cells[-1]]
    assert scanpath.shifts <= 3
    assert scanpath.beliefs.shape == (len(scanpath), 48, 3)
    assert torch.equal(scanpath.fixations, grid.centres[scanpath.cells])
    assert len(set(scanpath.cells.tolist())) == len(scanpath)


def test_boxes_decide_what_is_found(agent, image):
    nowhere = torch.tensor([[60.0, 60, 61, 61]])
    scanpath = agent.search(image, "green", start=0, boxes=nowhere, shifts=5)
    hit = Grid(8, 6, SIZE).footprint(nowhere)[0].nonzero()[0, 0]
    assert scanpath.found == (int(hit) in scanpath.cells.tolist())
    assert scanpath.shifts <= 5
    assert agent.search(image, "red", start=0, boxes=torch.tensor([[0.0, 0, 30, 30]])).shifts == 0


def test_beliefs_are_those_of_a_semantic_map(agent, image):
    scanpath = agent.search(image, "green", start=20, shifts=4, boxes=torch.tensor([[0.0, 119, 1, 120]]))
    own = SemanticMap(Grid(8, 6, SIZE), ["red", "green"])
    eye = Eye(Foveation(40.0), Squares(), reference=160.0)
    for fixation, belief, seen in zip(scanpath.fixations, scanpath.beliefs, scanpath.detections, strict=True):
        detections = eye(image[None], fixation[None])
        torch.testing.assert_close(detections.boxes, seen.boxes)
        own.update(detections, fixation[None])
        torch.testing.assert_close(own.beta[0], belief)


def test_what_observers_learned_moves_with_the_agent(image):
    misses = FovealObservationModel.identity(["red", "green"], [0.2], miss_rate=torch.full((3, 2), 0.5))
    agent = ActivePerception(
        Foveation(40.0), Squares(), None, (8, 6), search_policy("non-predictive"), reference=160.0,
        semantics=SemanticObserver(3, misses=misses.miss_likelihood), observer=TargetObserver(TargetEvidence(4, 4)),
    )  # fmt: skip
    assert set(agent.learned) == {misses, agent.observer.model}
    agent.double().requires_grad_(False)
    scanpath = agent.search(image.double(), "green", start=0, shifts=2)
    assert scanpath.posterior.dtype == scanpath.beliefs.dtype == misses.edges.dtype == torch.float64
    other = copy.deepcopy(agent)
    assert other.observer.model is not agent.observer.model
    assert other.observer.model in set(other.learned)
    assert not ActivePerception(
        Foveation(40.0), Squares(), misses, (8, 6), search_policy("non-predictive"), reference=160.0
    ).learned


def test_same_seed_same_scanpath(agent, image):
    empty = torch.full_like(image, 0.4)
    first, second, other = (agent.search(empty, "red", seed=seed, shifts=9).cells for seed in (3, 3, 4))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


def test_search_ends_when_every_cell_was_visited(image):
    agent = ActivePerception(Foveation(40.0), Squares(), None, (3, 2), search_policy("random"), reference=160.0)
    scanpath = agent.search(torch.full_like(image, 0.4), "red", shifts=50)
    assert not scanpath.found
    assert sorted(scanpath.cells.tolist()) == list(range(6))


@pytest.fixture
def explorer():
    """An agent that calibrates what it sees and looks where it expects to learn most."""
    clarity = torch.tensor([4.0, 1.0, 0.2])
    alpha = 1 + torch.eye(3)[:, None] * clarity[:, None]
    model = FovealObservationModel(alpha, [0.2, 0.4], ["red", "green"]).requires_grad_(False).eval()
    policy = exploration_policy("kl", model)
    return ActivePerception(Foveation(40.0), Squares(), model, (8, 6), policy, reference=160.0)


def test_exploration_makes_all_its_gaze_shifts(explorer, image):
    scanpath = explorer.explore(image, start=0, shifts=6)
    assert scanpath.shifts == 6
    assert scanpath.target is None
    assert not scanpath.found
    assert len(set(scanpath.cells.tolist())) == 7
    # Each fixation is the best that was left after the looks before.
    for number in range(6):
        left = scanpath.values[number].clone()
        assert left.max() > left.min() * 1.01
        left[scanpath.cells[: number + 1]] = -torch.inf
        assert left[scanpath.cells[number + 1]] >= left.max() * (1 - 1e-6)
    own = SemanticMap(Grid(8, 6, SIZE), ["red", "green"], observation=explorer.observation)
    for fixation, seen in zip(scanpath.fixations, scanpath.detections, strict=True):
        own.update(seen, fixation[None])
    torch.testing.assert_close(own.beta[0], scanpath.beliefs[-1])


def test_exploration_ends_when_every_cell_was_visited(image):
    agent = ActivePerception(Foveation(40.0), Squares(), None, (3, 2), exploration_policy("random"), reference=160.0)
    assert sorted(agent.explore(image, shifts=50).cells.tolist()) == list(range(6))
    first, second = (agent.explore(image, shifts=5, seed=seed).cells for seed in (1, 2))
    assert torch.equal(agent.explore(image, shifts=5, seed=1).cells, first)
    assert not torch.equal(first, second)


def test_an_agent_that_calibrates_may_see_nothing(explorer, image):
    scanpath = explorer.explore(torch.full_like(image, 0.4), start=3, shifts=2)
    assert scanpath.beliefs.unique().tolist() == [0.5]


def test_exploration_needs_a_policy_without_target(agent, image):
    with pytest.raises(InputError, match="exploration_policy"):
        agent.explore(image)


def test_class_names_are_suggested(agent, image):
    with pytest.raises(InputError, match="did you mean 'green'"):
        agent.search(image, "gren")
    with pytest.raises(InputError, match="target"):
        agent.search(image, 3)
    with pytest.raises(InputError, match="start"):
        agent.search(image, 1, start=48)


def test_step_marks_visits_and_fuses(image):
    grid = Grid(8, 6, SIZE)
    detections = Squares()(image[None])
    observer = SemanticObserver(3)
    evidence = observer.weigh(detections, grid.centres[:1], grid)
    belief, visited = observer.start(1, grid, image), torch.zeros(1, 48, dtype=torch.bool)
    visited[0, 9] = True
    acquisition = search_policy("non-predictive")(1, grid)
    after = step(observer, belief, visited, torch.tensor([0]), evidence, acquisition, torch.rand(1, 48))
    assert after.visited[0].nonzero()[:, 0].tolist() == [0, 9]
    red = Grid(8, 6, SIZE).footprint(torch.tensor([[8.0, 8, 28, 28]]))[0]
    assert red[after.cell[0]]
    assert after.cell[0] not in (0, 9)
    assert torch.equal(belief.beta, torch.full((1, 48, 3), 0.5))


def test_confirmation_needs_place_class_and_score():
    grid = Grid(8, 6, SIZE)
    boxes = torch.tensor([[[10.0, 10, 19, 19]]])
    sure = Detections(boxes, torch.tensor([[[0.1, 0.8, 0.1]]]), torch.tensor([[True]]))
    unsure = Detections(boxes, torch.tensor([[[0.1, 0.4, 0.5]]]), torch.tensor([[True]]))
    assert confirms(sure, grid, 0, 1, 0.5)
    assert not confirms(sure, grid, 1, 1, 0.5)
    assert not confirms(sure, grid, 0, 1, 0.9)
    assert not confirms(unsure, grid, 0, 1, 0.3)
    padded = Detections(boxes, torch.tensor([[[0.1, 0.8, 0.1]]]), torch.tensor([[False]]))
    assert not confirms(padded, grid, 0, 1, 0.5)


def test_view_is_foveated_at_the_resolution_of_the_detector(image):
    """A photograph of twice the size, its fovea scaled with it, gives the same view."""
    eye = Eye(Foveation(30.0), Squares(), reference=160.0)
    large = image.repeat_interleave(2, -1).repeat_interleave(2, -2)
    small_view = eye.foveated(eye.open(image[None]), torch.tensor([[39.5, 19.5]]))
    large_view = eye.foveated(eye.open(large[None]), torch.tensor([[79.5, 39.5]]))
    torch.testing.assert_close(small_view, large_view, atol=0.05, rtol=0)
    sharp = (small_view[0, :, 8:28, 8:28] - image[:, 8:28, 8:28]).abs().mean()
    blurred = (small_view[0, :, 100:110, 130:140] - image[:, 100:110, 130:140]).abs().mean()
    assert blurred > 3 * sharp


@pytest.mark.parametrize("growth", [1.0, 2.0])
def test_view_shows_what_the_sensor_shows_of_a_reference_image(growth):
    """Blurring the photograph and shrinking it is the same as shrinking it and blurring with matched bands."""
    generator = torch.Generator().manual_seed(0)
    # Detail at all scales, as photographs have it.
    picture = torch.zeros(1, 3, 480, 640)
    for n in (2, 4, 8, 16, 32):
        coarse = torch.rand(1, 3, 480 // n, 640 // n, generator=generator)
        picture += torch.nn.functional.interpolate(coarse, (480, 640), mode="bilinear") / 5
    gaze = torch.tensor([[200.0, 250.0]])
    eye = Eye(Foveation(60.0, growth=growth), Squares())
    view = eye.open(picture)
    got = eye.foveated(view, gaze)
    shown, _ = eye.detector.fit(Foveation(60.0, growth=growth)(picture, gaze[None])[0])
    scaled = foveate(view.bands, view.placement.points_to_canvas(gaze)[None], sigma=15.0, growth=growth)[0]
    error, other = ((each - shown).square().mean().sqrt() for each in (got, scaled))
    assert error < 0.02
    assert error <= other
