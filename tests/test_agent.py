"""The agent as a whole, with a detector that sees coloured squares."""

import copy
import pickle

import pytest
import torch
from PIL import Image
from torch.nn import functional as F

from semfov import (
    ActivePerception,
    Detections,
    FovealObservationModel,
    Foveation,
    Grid,
    HeadAgent,
    ZoomAgent,
    load_detector,
    saliency,
)
from semfov.agents.picture import OpenedPicture
from semfov.belief.observers import Semantic, SemanticSearch
from semfov.data.examples import example_scene
from semfov.decision import confirms
from semfov.episode import STAGES
from semfov.errors import InputError
from semfov.eye import Eye
from semfov.gaze.policies import Policy
from semfov.io.state import without_settings
from semfov.paths import GazePrediction
from semfov.sensor import foveate
from tests.refusals import refused
from tests.small import Coloured

SIZE = (160, 120)


@pytest.fixture
def image():
    """A red square at the top left and a smaller green one at the bottom right, on grey."""
    picture = torch.full((3, 120, 160), 0.4)
    picture[:, 8:28, 8:28] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    picture[:, 100:110, 130:140] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]
    return picture


def squares_eye():
    return Eye(Foveation(40.0), Coloured(), reference=160.0)


@pytest.fixture
def agent():
    return ActivePerception(
        squares_eye(), (Semantic(3), Policy("non-predictive")), (Semantic(3), Policy("random")), grid=(8, 6)
    )


def test_search_goes_to_the_target(agent, image):
    scanpath = agent.search(image, "green", start=0)
    assert scanpath.found
    assert scanpath.classes[scanpath.target] == "green"
    grid = Grid(8, 6, SIZE)
    goal = grid.footprint(torch.tensor([[130.0, 100, 140, 110]]))[0]
    assert goal[scanpath.cells[-1]]
    assert scanpath.shifts <= 3
    assert scanpath.probabilities.shape == (len(scanpath), 48, 3)
    assert torch.equal(scanpath.fixations, grid.centres[scanpath.cells])
    assert len(set(scanpath.cells.tolist())) == len(scanpath)


def test_the_map_of_all_classes_is_made_when_it_is_read(agent, image, monkeypatch):
    updates, update = [], Semantic.update

    def counted(self, belief, look):
        updates.append(self)
        return update(self, belief, look)

    monkeypatch.setattr(Semantic, "update", counted)
    path = agent.search(image, "green", start=0, shifts=2)
    looks = [each for each in updates if each is agent.exploring.observer]
    assert looks == []
    copied = pickle.loads(pickle.dumps(path))
    assert len([each for each in updates if each is agent.exploring.observer]) == len(path)
    torch.testing.assert_close(path.posterior, copied.probabilities[..., path.target])
    assert torch.equal(path.probabilities, copied.probabilities)
    assert copied.describe() == path.describe()


@pytest.mark.parametrize("how", ["fovea", "windows"])
def test_objects_count_from_the_asked_score_on(agent, image, how):
    every = agent.find_all(image, how=how, passes=2, score_threshold=0.0)
    middle = float(every.candidates.scores.median())
    start = {"start": 0} if how == "fovea" else {}
    for some in (
        agent.find_all(image, how=how, passes=2, score_threshold=middle),
        agent.explore(image, how=how, passes=2, score_threshold=middle, **start),
    ):
        assert some.score_threshold == middle
        assert len(some.objects) == int((some.candidates.scores >= middle).sum())
    refused("score_threshold", agent.find_all, image, how=how, passes=2, score_threshold=1.5)


def test_predictive_policies_search_for_one_class_only(image):
    model = FovealObservationModel.identity(["red", "green"], [0.2])
    ahead = ActivePerception(
        squares_eye(), (Semantic(3), Policy("predictive", model)), (Semantic(3), Policy("random")), grid=(8, 6)
    )
    refused("one class for policy 'predictive'", ahead.search, image, {"red": 1.0, "green": 0.8}, how="fovea")


class Weighted(Coloured):
    """A detector with a parameter, and boxes and scores in the precision of it."""

    def __init__(self) -> None:
        super().__init__()
        self.white = torch.nn.Parameter(torch.ones(1))

    def propose(self, canvas):
        return super().propose(canvas.to(self.white.dtype) * self.white)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_for_the_detector_alone(image, dtype):
    """In half precision the agent does what it does with only its detector in half precision."""
    model = FovealObservationModel.identity(["red", "green"], [0.2])
    eye = Eye(Foveation(40.0), Weighted(), reference=160.0)
    agent = ActivePerception(
        eye, (Semantic(3, model), Policy("non-predictive")), (Semantic(3), Policy("kl", model)), grid=(8, 6)
    )
    agent.requires_grad_(False)
    other = copy.deepcopy(agent)
    other.eye.detector.to(dtype)
    agent.to(dtype)
    assert agent.eye.detector.white.dtype == dtype
    state = without_settings(agent.state_dict())
    assert {value.dtype for name, value in state.items() if "detector" not in name} == {torch.float32}
    for task in (lambda agent: agent.search(image, "green", start=0), lambda agent: agent.explore(image, shifts=3)):
        found = task(agent)
        assert found.probabilities.dtype == torch.float32
        assert torch.equal(found.probabilities, task(other).probabilities)
    assert agent.find_all(image, passes=1).objects.boxes.dtype == torch.float32
    assert agent.float().eye.detector.white.dtype == torch.float32


@pytest.mark.parametrize("convert", ["half", "bfloat16"])
def test_half_precision_that_a_detector_has_not_is_refused(convert):
    """A file of ONNX has no parameters, so that nothing would change."""
    agent = ActivePerception.raw(Coloured())
    with pytest.raises(InputError, match="half: expected a detector of PyTorch, got coloured, which has no parameters"):
        getattr(agent, convert)()
    assert agent.double() is agent


@pytest.mark.weights
@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_a_device_that_is_not_there_is_refused_with_those_that_are():
    agent = ActivePerception.raw(Coloured())
    for ask in (lambda: agent.to("cuda"), agent.cuda, lambda: load_detector("yolov3-tiny", device="cuda")):
        with pytest.raises(InputError, match=r"device: expected one that PyTorch has here \(cpu.*\), got "):
            ask()


def test_what_is_no_device_is_refused_by_every_part():
    agent = ActivePerception.raw(Coloured())
    for part in (agent, agent.eye, agent.eye.detector, agent.eye.sensor):
        for move in (lambda part=part: part.to("gpu"), lambda part=part: part.to(device="gpu")):
            with pytest.raises(
                InputError, match="device: expected a device of PyTorch, such as cpu or cuda, got 'gpu'"
            ):
                move()
        assert part.to("cpu") is part.to(torch.device("cpu"), torch.float32) is part


@pytest.mark.parametrize("mapper", [{}, {"prior": 0.25, "fusion": "sum"}], ids=["same", "other"])
def test_search_keeps_the_beliefs_of_both_observers(image, mapper):
    """The map of all classes is that of the exploring observer, the posterior that of the searching observer."""
    agent = ActivePerception(
        squares_eye(), (Semantic(3), Policy("non-predictive")), (Semantic(3, **mapper), Policy("random")), grid=(8, 6)
    )
    scanpath = agent.search(image, "green", start=20, shifts=4, boxes=torch.tensor([[0.0, 119, 1, 120]]))
    assert len(scanpath) == 5
    grid, eye = Grid(8, 6, SIZE), squares_eye()
    keeper, seeker = Semantic(3, **mapper), Semantic(3)
    known, sought = keeper.start(1, grid, image), seeker.start(1, grid, image)
    for number, fixation in enumerate(scanpath.fixations):
        detections = eye(image[None], fixation[None])
        torch.testing.assert_close(detections.boxes, scanpath.detections[number].boxes)
        known = keeper(known, detections, fixation[None], grid)
        sought = seeker(sought, detections, fixation[None], grid)
        torch.testing.assert_close(known.probabilities[0], scanpath.probabilities[number])
        torch.testing.assert_close(sought.probability(2)[0], scanpath.posterior[number])


def test_an_observer_shared_by_both_tasks_has_one_belief(image):
    """If both tasks share an observer, the map and the posterior of a search are one belief."""
    shared = Semantic(3)
    agent = ActivePerception(squares_eye(), (shared, Policy("non-predictive")), (shared, Policy("random")), grid=(8, 6))
    apart = ActivePerception(
        squares_eye(), (shared, Policy("non-predictive")), (Semantic(3), Policy("random")), grid=(8, 6)
    )
    one, other = (each.search(image, "green", start=0) for each in (agent, apart))
    assert torch.equal(one.cells, other.cells)
    assert torch.equal(one.probabilities, other.probabilities)
    torch.testing.assert_close(one.posterior, one.probabilities[..., 2])


def test_learned_models_are_submodules_of_the_agent(image):
    """State, dtype, gradients and copies of the agent include the models of its observers and policies."""
    misses = FovealObservationModel.identity(["red", "green"], [0.2], miss_rate=torch.full((3, 2), 0.5))
    sought = FovealObservationModel.identity(["red", "green"], [0.2], miss_odds=torch.full((3, 2), 0.3))
    expected = FovealObservationModel.identity(["red", "green"], [0.3])
    search = SemanticSearch(sought), Policy("non-predictive")
    agent = ActivePerception(squares_eye(), search, (Semantic(3, misses=misses), Policy("kl", expected)), grid=(8, 6))
    learned = {
        "searching.observer.model": sought,
        "exploring.observer.misses": misses,
        "exploring.policy.model": expected,
    }
    state, named = agent.state_dict(), dict(agent.named_parameters())
    for path, model in learned.items():
        assert agent.get_submodule(path) is model
        assert {f"{path}.{name}" for name in model.state_dict()} <= set(state)
        for name, parameter in model.named_parameters():
            assert named[f"{path}.{name}"] is parameter
    assert len([*sought.parameters()]) > 0
    agent.double().requires_grad_(False)
    for model in learned.values():
        assert all(
            tensor.dtype == torch.float64 for tensor in model.state_dict().values() if tensor.is_floating_point()
        )
    scanpath = agent.search(image.double(), "green", start=0, shifts=2)
    assert scanpath.posterior.dtype == scanpath.probabilities.dtype == misses.edges.dtype == torch.float64
    other = copy.deepcopy(agent)
    for path, model in learned.items():
        twin = other.get_submodule(path)
        assert twin is not model
        for name, tensor in twin.state_dict().items():
            assert torch.equal(tensor, model.state_dict()[name])
            assert tensor.data_ptr() != model.state_dict()[name].data_ptr()
    again = other.search(image.double(), "green", start=0, shifts=2)
    assert torch.equal(again.posterior, scanpath.posterior)
    with torch.no_grad():
        next(other.searching.observer.model.parameters()).add_(1)
    assert torch.equal(agent.search(image.double(), "green", start=0, shifts=2).posterior, scanpath.posterior)
    # This agent has no learned models; the state of another agent is loaded into this one.
    plain = ActivePerception(squares_eye(), (Semantic(3), Policy("non-predictive")), (Semantic(3), Policy("random")))
    assert all(name.startswith("eye.") for name in plain.state_dict())
    other.load_state_dict(agent.state_dict())
    assert torch.equal(other.search(image.double(), "green", start=0, shifts=2).posterior, scanpath.posterior)


def test_a_model_shared_by_observer_and_policy_is_stored_once(image):
    """Observer and policy use the same model, and so do the observer and policy of a copy."""
    model = FovealObservationModel.identity(["red", "green"], [0.2])
    observer = Semantic(3, model)
    agent = ActivePerception(
        squares_eye(), (observer, Policy("predictive", model)), (observer, Policy("kl", model)), grid=(8, 6)
    )
    assert [*agent.parameters()] == [*squares_eye().parameters(), *model.parameters()]
    twin = copy.deepcopy(agent)
    assert twin.exploring.policy.model is twin.searching.policy.model is twin.searching.observer.observation
    assert twin.exploring.observer is twin.searching.observer


def test_same_seed_same_scanpath(agent, image):
    empty = torch.full_like(image, 0.4)
    first, second, other = (agent.search(empty, "red", seed=seed, shifts=9).cells for seed in (3, 3, 4))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)


@pytest.fixture
def explorer():
    """An agent that calibrates its detections and looks where it expects the largest information gain."""
    clarity = torch.tensor([4.0, 1.0, 0.2])
    alpha = 1 + torch.eye(3)[:, None] * clarity[:, None]
    model = FovealObservationModel(alpha, [0.2, 0.4], ["red", "green"]).requires_grad_(False).eval()
    observer = Semantic(3, model)
    return ActivePerception(
        squares_eye(), (observer, Policy("non-predictive")), (observer, Policy("kl", model)), grid=(8, 6)
    )


def test_exploration_makes_the_given_number_of_gaze_shifts(explorer, image):
    scanpath = explorer.explore(image, start=0, shifts=6)
    assert scanpath.shifts == 6
    assert scanpath.target is None
    assert not scanpath.found
    assert len(set(scanpath.cells.tolist())) == 7
    # Each fixation has the highest value among the cells that were not yet visited.
    for number in range(6):
        left = scanpath.values[number].clone()
        assert left.max() > left.min() * 1.01
        left[scanpath.cells[: number + 1]] = -torch.inf
        assert left[scanpath.cells[number + 1]] >= left.max() * (1 - 1e-6)
    grid, observer = Grid(8, 6, SIZE), Semantic(3, explorer.exploring.policy.model)
    belief = observer.start(1, grid, image)
    for fixation, seen in zip(scanpath.fixations, scanpath.detections, strict=True):
        belief = observer(belief, seen, fixation[None], grid)
    torch.testing.assert_close(belief.probabilities[0], scanpath.probabilities[-1])


def test_exploration_ends_when_every_cell_was_visited(image):
    agent = ActivePerception(
        squares_eye(), (Semantic(3), Policy("random")), (Semantic(3), Policy("random")), grid=(3, 2)
    )
    assert sorted(agent.explore(image, shifts=50).cells.tolist()) == list(range(6))
    first, second = (agent.explore(image, shifts=5, seed=seed).cells for seed in (1, 2))
    assert torch.equal(agent.explore(image, shifts=5, seed=1).cells, first)
    assert not torch.equal(first, second)


def test_an_agent_that_calibrates_accepts_looks_without_detections(explorer, image):
    scanpath = explorer.explore(torch.full_like(image, 0.4), start=3, shifts=2)
    torch.testing.assert_close(scanpath.probabilities, torch.full_like(scanpath.probabilities, 1 / 3))


def test_every_look_of_an_agent_is_timed(agent, image):
    for scanpath in (agent.search(image, "green", start=0), agent.explore(image, start=0, shifts=2)):
        assert len(scanpath.seconds) == len(scanpath)
        for seconds in scanpath.seconds:
            assert tuple(seconds) == STAGES
            assert min(seconds.values()) > 0


def test_confirmation_of_a_batch_equals_that_of_each_look():
    grid, generator = Grid(4, 3, SIZE), torch.Generator().manual_seed(0)
    corner = torch.rand(40, 3, 2, generator=generator) * 100
    boxes = torch.cat([corner, corner + 5 + torch.rand(40, 3, 2, generator=generator) * 40], -1)
    scores, mask = torch.rand(40, 3, 3, generator=generator), torch.rand(40, 3, generator=generator) < 0.8
    cell = torch.randint(12, (40,), generator=generator)
    expected = []
    for look in range(40):
        answer = False
        for detection in range(3):
            x, y, z, w = boxes[look, detection].tolist()
            left, top = int(cell[look]) % 4 * 40, int(cell[look]) // 4 * 40
            there = x < left + 40 and z > left and y < top + 40 and w > top
            sure = scores[look, detection].tolist()
            answer |= bool(mask[look, detection]) and there and sure[2] >= 0.6
        expected.append(answer)
    assert 0 < sum(expected) < 40
    assert confirms(Detections(boxes, scores, mask), grid, cell, 2, 0.6).tolist() == expected


def test_view_is_foveated_at_the_resolution_of_the_detector(image):
    """A photograph of twice the size gives the same view, as the fovea is scaled with it."""
    eye = Eye(Foveation(30.0), Coloured(), reference=160.0)
    large = image.repeat_interleave(2, -1).repeat_interleave(2, -2)
    small_view = eye.foveated(eye.open(image[None]), torch.tensor([[39.5, 19.5]]))
    large_view = eye.foveated(eye.open(large[None]), torch.tensor([[79.5, 39.5]]))
    torch.testing.assert_close(small_view, large_view, atol=0.05, rtol=0)
    sharp = (small_view[0, :, 8:28, 8:28] - image[:, 8:28, 8:28]).abs().mean()
    blurred = (small_view[0, :, 100:110, 130:140] - image[:, 100:110, 130:140]).abs().mean()
    assert blurred > 3 * sharp


@pytest.mark.parametrize("growth", [1.0, 2.0])
def test_view_equals_the_reduced_output_of_the_sensor(growth):
    """Blurring a photograph before reducing it equals reducing it and then blurring with matched bands."""
    generator = torch.Generator().manual_seed(0)
    # Detail at all scales, as in photographs.
    picture = torch.zeros(1, 3, 480, 640)
    for n in (2, 4, 8, 16, 32):
        coarse = torch.rand(1, 3, 480 // n, 640 // n, generator=generator)
        picture += torch.nn.functional.interpolate(coarse, (480, 640), mode="bilinear") / 5
    gaze = torch.tensor([[200.0, 250.0]])
    eye = Eye(Foveation(60.0, growth=growth), Coloured())
    view = eye.open(picture)
    got = eye.foveated(view, gaze)
    shown, _ = eye.detector.fit(Foveation(60.0, growth=growth)(picture, gaze[None])[0])
    scaled = foveate(view.state[0], view.placement.points_to_canvas(gaze)[None], sigma=15.0, growth=growth)[0]
    error, other = ((each - shown).square().mean().sqrt() for each in (got, scaled))
    assert error < 0.02
    # With growth 1 both views are the same up to rounding.
    assert error <= other * (1 + 1e-4)
    assert growth == 1 or error < other / 2


@pytest.mark.parametrize(
    ("make", "options", "said"),
    [
        (ActivePerception.recommended, {"columns": 12}, r"columns: expected an option of .*; did you mean grid=\?$"),
        (ActivePerception.from_pretrained, {"strides": 32}, r"strides: .*; did you mean stride=\?$"),
        (ActivePerception.published, {"treshold": 0.1}, r"treshold: .*; did you mean threshold=\?$"),
        (ActivePerception.published, {"rows": 3}, r"rows: .*, got an unknown one; known: name, sensor,"),
        (ActivePerception.recommended, {"sigma": 50.0}, r"sigma: .*, got an unknown one; known: name, grid,"),
        (ActivePerception.raw, {"treshold": 0.1}, r"treshold: .*; did you mean threshold=\?$"),
        (ZoomAgent.recommended, {"finst": 0.5}, r"finst: .*; did you mean finest="),
        (
            HeadAgent.recommended,
            {"grid": (3, 3)},
            r"grid: expected an option of semfov.load_detector for yolov3-tiny, got an unknown",
        ),
    ],
)
def test_unknown_options_are_named_with_the_nearest_ones(make, options, said):
    refused(f"^{said}", make, "yolov3-tiny", **options)


def test_search_for_any_of_several_classes_finds_the_one_that_is_present(agent, image):
    image[:, 8:28, 8:28] = 0.4  # nothing red is left
    scanpath = agent.search(image, {"red": 1.0, "green": 0.8}, start=0)
    assert scanpath.found
    assert scanpath.classes[scanpath.target] == "green"
    corner = scanpath.decision.box.tolist()
    assert corner == pytest.approx([130, 100, 140, 110], abs=6)
    alone = agent.search(image, "green", start=0)
    assert torch.equal(agent.search(image, {"green": 1.0}, start=0).cells, alone.cells)
    # A detection of a class with a low weight does not confirm the target.
    assert not agent.search(image, {"red": 1.0, "green": 0.1}, start=0, shifts=6).found
    image[:, 8:28, 8:28] = 0.4  # nothing red is left
    listed, weighted = (
        agent.search(image, wanted, start=0) for wanted in (["red", "green"], {"red": 1.0, "green": 1.0})
    )
    assert listed.found
    assert torch.equal(listed.cells, weighted.cells)
    assert agent.search(image, ["red", "green"], how="fovea").found
    refused("one class for a search by windows", agent.search, image, ["red", "green"], how="windows")
    for several in (["red", "green"], {"red": 1.0, "green": 1.0}):
        refused("one class; find_all takes several, and how='fovea'", agent.search, image, several)


@pytest.mark.parametrize("task", ["search", "explore"])
def test_limits_end_an_episode(agent, image, task):
    """By passes, by the word of the caller and by time; what was seen so far is that of the whole episode."""
    run = {"search": lambda **how: agent.search(image, "red", start=47, confirm=1.0, **how)}.get(task, agent.explore)
    given = {} if task == "search" else {"start": 47}
    run = run if task == "search" else lambda **how: agent.explore(image, **given, **how)
    whole = run(shifts=6)
    few = run(passes=3)
    assert (few.ending, few.passes) == ("passes", 3)
    assert torch.equal(few.cells, whole.cells[:3])
    records = []
    stopped = run(on_look=lambda record: records.append(record) or len(record) < 4)
    assert (stopped.ending, len(stopped)) == ("stopped", 4)
    assert [len(record) for record in records] == [1, 2, 3, 4]
    assert torch.equal(records[-1].probabilities, whole.probabilities[:4])
    instant = run(seconds=0)
    assert (instant.ending, len(instant)) == ("seconds", 1)
    for wrong in ({"passes": 0}, {"seconds": -1}, {"on_look": 3}, {"duration": 2.0}):
        refused(next(iter(wrong)), run, **wrong)


def test_the_kind_of_look_follows_from_the_picture(agent):
    small, large = torch.rand(3, 120, 160), torch.rand(3, 480, 640)
    assert agent.kind_of_look(small) == "fovea"
    assert agent.kind_of_look(small, every=True) == "windows"
    assert agent.kind_of_look((large * 255).byte()) == "windows"
    assert agent.kind_of_look(large.permute(1, 2, 0).numpy()) == "windows"
    assert agent.kind_of_look(large, "fovea") == "fovea"
    assert agent.search(large, "red", how="fovea", shifts=1).image.shape == large.shape
    refused(r"shifts: expected none .* use passes=, or how='fovea'", agent.search, large, "red", shifts=2)
    refused("unknown kind of look 'zoom'", agent.search, small, "red", how="zoom")


def test_grids_and_parts_that_do_not_suit_are_refused():
    for grid in [(0, 5), (5, -1), (5, 1.5), (5,), (5, 5, 5), (201, 1)]:
        with pytest.raises(InputError, match=r"^grid: expected"):
            ActivePerception(squares_eye(), (Semantic(3), Policy("random")), (Semantic(3), Policy("random")), grid=grid)
    settings = Eye(Foveation(40.0, growth=1.0), Coloured(), reference=160.0).settings()
    model = FovealObservationModel.identity(["red", "green"], [0.2])
    model.metadata.update(sensor=settings["sensor"])
    with pytest.raises(InputError, match=r"growth is 2\.0, the model was fitted with 1\.0"):
        ActivePerception(
            squares_eye(), (Semantic(3, model), Policy("non-predictive")), (Semantic(3), Policy("random")), grid=(8, 6)
        )


def test_all_objects_are_found_by_the_fovea(agent, image):
    record = agent.find_all(image, ["red", "green"], how="fovea", passes=6)
    assert (record.how, record.passes, record.target, record.decision) == ("fovea", 6, None, None)
    assert set(record.objects.labels.tolist()) == {1, 2}
    assert list(record.expected) == ["red", "green"]
    alone = agent.find_all(image, "green", how="fovea", passes=6).objects
    assert set(alone.labels.tolist()) == {2}
    assert any(box == pytest.approx([130, 100, 140, 110], abs=6) for box in alone.boxes.tolist())


def test_an_exploration_as_people_look_follows_the_density(agent, image, monkeypatch):
    """People who look at one place alone are followed there; the looks are those of any exploration."""
    model = saliency.FixationDensity({"none": 1}).requires_grad_(False)
    where = torch.full((1, 39, 52), -30.0)
    where[0, 20:25, 30:36] = 30.0
    terms = {"map": where, "centre bias": torch.zeros(1, 39, 52)}
    seen = GazePrediction(model, terms, SIZE, torch.zeros(3, 6, 8, dtype=torch.uint8))
    monkeypatch.setattr(GazePrediction, "of", classmethod(lambda cls, detector, image: seen))
    path = agent.explore(image, policy="people", shifts=1, start=0)
    x, y = path.fixations[1].tolist()
    cell = 8, 6
    assert 30 / 52 - 1 / cell[0] < x / SIZE[0] < 36 / 52 + 1 / cell[0]
    assert 20 / 39 - 1 / cell[1] < y / SIZE[1] < 25 / 39 + 1 / cell[1]
    assert len(agent.explore(image, policy="people", shifts=5, start=0)) == 6
    refused("policy: expected 'people', or None, got cats", agent.explore, image, policy="cats")
    with pytest.raises(InputError, match=r"policy: expected none for .* by windows, got people"):
        agent.explore(image, how="windows", policy="people")


def test_a_fovea_reads_the_bytes_of_a_large_picture(tmp_path, monkeypatch):
    """Its floats would take gigabytes; looks, closer ones too, show what they show of floats, in its pixels."""
    agent = ActivePerception.recommended()
    photograph = example_scene("market", ["person"]).image
    height, width = (7 * side for side in photograph.shape[-2:])  # large enough to be reduced
    path = tmp_path / "large.png"
    pixels = F.interpolate(photograph[None], (height, width), mode="bicubic")[0].clamp(0, 1)
    Image.fromarray((255 * pixels.permute(1, 2, 0)).byte().numpy()).save(path)

    def look(box):
        eye = agent.eye
        image = OpenedPicture.of(path).pixels(eye.sensor.like)
        close = eye.close_up(image, torch.tensor(box))
        return agent.explore(path, how="fovea", shifts=2), agent.search(path, "person", how="fovea", shifts=2), close

    box = [0.1 * width, 0.7 * height, 0.25 * width, 0.85 * height]
    expected, found, close = look(box)
    for module in ("semfov.eye", "semfov.agents.picture"):
        monkeypatch.setattr(f"{module}.MOST_FLOATS", 1000)
    monkeypatch.setattr("semfov.agents.picture.as_image", lambda *_, **__: pytest.fail("floats of all pixels"))
    explored, found_on_bytes, close_on_bytes = look(box)
    assert explored.size == expected.size == (width, height)
    assert torch.equal(explored.fixations, expected.fixations)
    assert len(explored.objects) == len(expected.objects) >= 1
    torch.testing.assert_close(explored.objects.boxes, expected.objects.boxes, atol=0.004 * width, rtol=0)
    assert (explored.photograph.int() - expected.photograph.int()).abs().float().mean() < 1
    assert found_on_bytes.decision.probability == pytest.approx(found.decision.probability, abs=0.02)
    best, best_on_bytes = (detections.scores[0, :, 1:].max() for detections in (close, close_on_bytes))
    assert best > 0.3
    assert float(best_on_bytes) == pytest.approx(float(best), abs=0.05)
