"""Every public module as a part of somebody else's module: copied, moved, saved, compiled, exported, vectorised."""

import copy
import io
import pickle
from collections.abc import Callable
from functools import partial
from inspect import isabstract, isclass

import pytest
import torch
from torch import Tensor, nn

import semfov
from docs.api import entries
from semfov import Eye, FovealObservationModel, Foveation, Grid, acquisition, fusion, policies, saliency
from semfov.agent import ActivePerception
from semfov.belief import ContextPrior, DirichletBelief, MapEvidence, TargetEvidence
from semfov.belief.observers import AnyOf, Context, Landing, LearnedMap, Observer, Semantic, Target
from semfov.detection import Candidates, Detections, Detector, Selection
from semfov.gaze import IVSN, GazeHabits, LearnedGaze, Policy, select_fixation
from semfov.gaze.templates import ClassTemplates
from semfov.observation import FoldedObservationModel
from semfov.sensor import Glimpse, LogPolar, Perspective, RandomFoveation
from semfov.zoom import GlimpseEvidence

CLASSES = ("cat", "cup", "person")
GRID = Grid(4, 3, (64, 48))


class Host(nn.Module):
    """Somebody else's module: it scales what the part returns by a parameter of its own."""

    def __init__(self, part: nn.Module) -> None:
        super().__init__()
        self.part = part
        self.gain = nn.Parameter(torch.tensor(2.0))

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.gain * self.part(*inputs)


class Blobs(Detector):
    """As many detections as there are quarters of the canvas, scored by a linear layer from their mean colour."""

    def __init__(self) -> None:
        super().__init__("blobs", CLASSES, (64, 48), selection=Selection(threshold=0.0, iou=1.0))
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.score = nn.Linear(3, len(CLASSES))

    def propose(self, canvas: Tensor) -> Candidates:
        corners = canvas.new_tensor([[0, 0], [32, 0], [0, 24], [32, 24]])
        boxes = torch.cat([corners, corners + canvas.new_tensor([32, 24])], -1)
        colours = nn.functional.avg_pool2d(canvas, (24, 32)).flatten(2).mT
        return Candidates(boxes.expand(len(canvas), 4, 4), self.score(colours).sigmoid().to(canvas))


class Looking(nn.Module):
    """A look as tensors: scores `(B, L, K+1)`, boxes and fixations."""

    def __init__(self, part: nn.Module, *arguments: object) -> None:
        super().__init__()
        self.part = part
        self.arguments = arguments

    def forward(self, scores: Tensor, boxes: Tensor, fixation: Tensor) -> Tensor:
        seen = Detections(boxes, scores, torch.ones(scores.shape[:2], dtype=torch.bool, device=scores.device))
        return self.part(seen, fixation, *self.arguments)


class Watching(nn.Module):
    """What an observer believes of a class after it was shown the same from two points."""

    def __init__(self, part: Observer) -> None:
        super().__init__()
        self.part = part

    def forward(self, scores: Tensor, boxes: Tensor, fixation: Tensor) -> Tensor:
        seen = Detections(boxes, scores, torch.ones(scores.shape[:2], dtype=torch.bool, device=scores.device))
        belief = self.part.start(len(scores), GRID, scores)
        for point in (fixation, fixation + 15):
            belief = self.part(belief, seen, point, GRID, 2)
        return belief.probability(2)


class Hinting(nn.Module):
    """What hints say of looks one octave closer."""

    def __init__(self, part: nn.Module) -> None:
        super().__init__()
        self.part = part

    def forward(self, scores: Tensor, summary: Tensor) -> Tensor:
        return self.part.presence(scores, summary, torch.ones(len(scores), dtype=torch.long, device=scores.device))


class Expecting(Looking):
    """What a further look is expected to bring, after one."""

    def forward(self, scores: Tensor, boxes: Tensor, fixation: Tensor) -> Tensor:
        seen = Detections(boxes, scores, torch.ones(scores.shape[:2], dtype=torch.bool, device=scores.device))
        mapper = LearnedMap(self.part.model)
        belief = mapper(mapper.start(len(scores), GRID, scores), seen, fixation, GRID)
        function = self.part(None, GRID) if isinstance(self.part, Policy) else self.part
        return function(belief, belief.visited)


class WholeMap(Watching):
    """The parameters of the belief about all classes after one look."""

    def forward(self, scores: Tensor, boxes: Tensor, fixation: Tensor) -> Tensor:
        seen = Detections(boxes, scores, torch.ones(scores.shape[:2], dtype=torch.bool, device=scores.device))
        return self.part(self.part.start(len(scores), GRID, scores), seen, fixation, GRID).beta


class Augmenting(nn.Module):
    """An augmentation at places that were drawn before."""

    def __init__(self) -> None:
        super().__init__()
        self.part = RandomFoveation((5.0, 9.0), p=1.0)

    def forward(self, image: Tensor, gaze: Tensor, sigma: Tensor) -> Tensor:
        drawn = {
            "gaze": gaze,
            "sigma": sigma,
            "batch_prob": torch.ones(len(image)),
            "forward_input_shape": torch.tensor(image.shape),
        }
        return self.part(image, params=drawn)


class Given(nn.Module):
    """A part with arguments that are no tensors."""

    def __init__(self, part: nn.Module, *arguments: object) -> None:
        super().__init__()
        self.part = part
        self.arguments = arguments

    def forward(self, *inputs: Tensor) -> Tensor:
        return self.part(*inputs, *self.arguments)


class Drawing(Given):
    """Log probabilities of the next cell, from a cell."""

    def forward(self, values: Tensor, cell: Tensor, age: Tensor) -> Tensor:
        return self.part(values, cell.long(), age, GRID)


class Valuing(nn.Module):
    """An acquisition function, given the parameters of a belief and how close the fovea was to each cell."""

    def __init__(self, part: nn.Module) -> None:
        super().__init__()
        self.part = part

    def forward(self, beta: Tensor, closest: Tensor) -> Tensor:
        return self.part(DirichletBelief(beta, closest), closest == 0)


class Deciding(nn.Module):
    """What a policy's acquisition function makes of a belief."""

    def __init__(self, part: Policy) -> None:
        super().__init__()
        self.part = part

    def forward(self, beta: Tensor, closest: Tensor) -> Tensor:
        return self.part(2, GRID)(DirichletBelief(beta, closest), closest == 0)


class Scores(nn.Module):
    """The scores that an eye sees."""

    def __init__(self) -> None:
        super().__init__()
        self.eye = Eye(Foveation(9.0), Blobs(), reference=64.0)

    def forward(self, image: Tensor, fixations: Tensor) -> Tensor:
        return self.eye(image, fixations).scores


class InOrder(Policy):
    """A policy whose choices do not hang on digits."""

    def forward(self, target: int | Tensor | None, grid: Grid) -> acquisition.AcquisitionFunction:
        return acquisition.Static(rand(len(grid)))


class Exploring(nn.Module):
    """What an agent believes after it has looked at three given cells."""

    def __init__(self) -> None:
        super().__init__()
        eye, strategy = Eye(Foveation(9.0), Blobs(), reference=64.0), (observing(), InOrder())
        self.agent = ActivePerception(eye, strategy, strategy, grid=(GRID.columns, GRID.rows))

    def forward(self, image: Tensor) -> Tensor:
        return self.agent.explore(image, start=5, shifts=2).probabilities


def memory() -> tuple[Tensor, Tensor]:
    closest = torch.minimum(*GRID.cell_distance[[2, 7]]).expand(2, -1).clone()
    return beliefs(), closest


def valuing(make: Callable[[], nn.Module]) -> nn.Module:
    return Valuing(make())


def context() -> nn.Module:
    return ContextPrior(CLASSES, rand(4, 3, 3), rand(4, 4, 3), [0.2, 0.4], weights={"map": (0.5, 0.2)})


def look() -> tuple[Tensor, Tensor, Tensor]:
    boxes = torch.tensor([[[4.0, 4, 30, 30], [20, 10, 60, 40]]])
    return rand(1, 2, 4).softmax(-1), boxes, torch.tensor([[20.0, 20.0]])


def rand(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(sum(shape)))


def model() -> FovealObservationModel:
    alpha = 0.5 + 4 * rand(4, 3, 4) + 3 * torch.eye(4)[:, None]
    return FovealObservationModel(alpha, [0.2, 0.5], CLASSES, miss_rate=0.1 + 0.8 * rand(4, 3)).eval()


def mapping() -> MapEvidence:
    return MapEvidence(4, 4, components=4).eval()


def observing() -> Semantic:
    return Semantic(4, model().requires_grad_(False))


def beliefs() -> Tensor:
    return 0.5 + 3 * rand(2, len(GRID), 4)


SEARCHERS: dict[str, Callable[[], nn.Module]] = {
    "TargetPosterior": lambda: acquisition.TargetPosterior(2),
    "PredictedTargetPosterior": lambda: acquisition.PredictedTargetPosterior(2, model()),
    "NeighbourhoodPosterior": lambda: acquisition.NeighbourhoodPosterior(2, model(), GRID),
    "FovealHit": lambda: acquisition.FovealHit(2, model(), GRID),
    "PlaceInformation": lambda: acquisition.PlaceInformation(2, model(), GRID),
    "SaliencyPrior": lambda: acquisition.SaliencyPrior(acquisition.TargetPosterior(2), rand(len(GRID)), weight=0.5),
    "LearnedGaze": lambda: policies.Learned(LearnedGaze())(2, GRID),
    "EntropyLimit": lambda: acquisition.EntropyLimit(2, model(), GRID),
    "TemplateAttention": lambda: acquisition.TemplateAttention(2, rand(len(GRID), 3, len(GRID)), GRID),
    "ObjectEvidence": acquisition.ObjectEvidence,
    "CloserLook": lambda: acquisition.CloserLook(GRID),
    "Static": lambda: acquisition.Static(rand(len(GRID))),
    "Uniform": acquisition.Uniform,
}
LOOKAHEADS = (
    acquisition.KLDivergence,
    acquisition.BayesianSurprise,
    acquisition.NegativeEntropy,
    acquisition.TwoPeaks,
    acquisition.UpperConfidenceBound,
    acquisition.ProbabilityOfImprovement,
)
EXPLORERS: dict[str, Callable[[], nn.Module]] = {make.__name__: partial(make, model(), GRID) for make in LOOKAHEADS} | {
    "ExpectedAccuracy": lambda: acquisition.ExpectedAccuracy(model(), GRID)
}
ACQUISITIONS = SEARCHERS | EXPLORERS
OTHERS: dict[str, tuple[Callable[[], nn.Module], Callable[[], tuple[Tensor, ...]]]] = {
    "ContextPrior": (lambda: Given(context(), GRID, 2), lambda: (rand(2, len(GRID), 4),)),
    "Foveation": (lambda: Foveation(9.0, learnable=True), lambda: (rand(2, 3, 48, 64), torch.tensor([20.0, 30.0]))),
    "Foveation, opencv": (
        lambda: Foveation(9.0, convention="opencv"),
        lambda: (rand(1, 3, 33, 47), torch.tensor([[5.0, 6.0]])),
    ),
    "LogPolar": (lambda: LogPolar(9.0), lambda: (rand(2, 3, 48, 64), torch.tensor([20.0, 30.5]))),
    "FovealObservationModel": (model, lambda: (rand(5, 6, 4).softmax(-1), rand(5, 6))),
    "FoldedObservationModel": (
        lambda: FoldedObservationModel(model()),
        lambda: (rand(5, 6, 4).softmax(-1), rand(5, 6)),
    ),
    "TargetEvidence": (lambda: Looking(TargetEvidence(4, 4).eval(), GRID, 2), look),
    "MapEvidence": (lambda: Looking(mapping(), GRID, torch.tensor([1, 2, 3])), look),
    "LearnedMap": (lambda: Watching(LearnedMap(mapping())), look),
    "ExpectedGain": (lambda: Expecting(acquisition.ExpectedGain(mapping(), GRID)), look),
    "Gain": (lambda: Expecting(policies.Gain(mapping())), look),
    "Semantic": (lambda: Watching(observing()), look),
    "Semantic, whole map": (lambda: WholeMap(observing()), look),
    "Semantic, misses": (lambda: Watching(Semantic(4, misses=model().requires_grad_(False), memory="closest")), look),
    "Target": (lambda: Watching(Target(TargetEvidence(4, 4).eval())), look),
    "Context": (lambda: Watching(Context(observing(), context())), look),
    "Landing": (lambda: Watching(Landing(3)), look),
    "AnyOf": (lambda: Watching(AnyOf(Target(TargetEvidence(4, 4).eval()), {1: 0.3, 2: 1.0})), look),
    "AnyOf, of one map": (lambda: Watching(AnyOf(LearnedMap(mapping()), {1: 0.3, 2: 1.0})), look),
    "ClassTemplates": (lambda: ClassTemplates(rand(3, 5), rand(5), CLASSES), lambda: (rand(2, 5, 4, 6),)),
    "VOCUS2": (saliency.VOCUS2, lambda: (rand(1, 3, 40, 60),)),
    "IttiKoch": (saliency.IttiKoch, lambda: (rand(1, 3, 64, 96),)),
}
# A policy makes its acquisition function, and that is what becomes a graph.
DECIDERS: dict[str, Callable[[], nn.Module]] = {
    "Random": policies.Random,
    "NonPredictive": policies.NonPredictive,
    "Learned": lambda: policies.Learned(LearnedGaze()),
    "Closer": policies.Closer,
    "Objects": policies.Objects,
} | {
    kind.__name__: partial(lambda kind: kind(model()), kind) for kind in policies.POLICIES.values() if kind.needs_model
}
# How many boxes are kept, when an episode ends, what is augmented depends on values: these are no single graph.
BRANCHING = {
    "Eye": (Scores, lambda: (rand(1, 3, 48, 64), torch.tensor([[20.0, 30.0], [5.0, 6.0]]))),
    "RandomFoveation": (Augmenting, lambda: (rand(2, 3, 48, 64), 40 * rand(2, 2), torch.tensor([5.0, 9.0]))),
    "ActivePerception": (Exploring, lambda: (rand(1, 3, 48, 64),)),
    "Perspective": (
        lambda: Perspective((20, 16)),
        lambda: (rand(1, 3, 32, 64), torch.tensor([[[30.0, 10.0, 60.0], [170.0, -80.0, 90.0]]])),
    ),
    "Glimpse": (
        lambda: Glimpse((32, 24)),
        lambda: (rand(1, 3, 48, 64), torch.tensor([[[20.0, 30.0], [50.0, 9.0]]]), torch.tensor([[0.5, 1.0]])),
    ),
    "CorrectLocalisation": (
        lambda: Valuing(acquisition.CorrectLocalisation(2, model(), GRID, nodes=8)),
        memory,
    ),
    "GazeHabits": (
        lambda: Drawing(GazeHabits(0.5, rand(len(GRID)), rand(3), [0.2, 0.5], rand(2), [2.0], 4)),
        lambda: (rand(2, len(GRID)), torch.tensor([1, 7]), torch.full((2, len(GRID)), torch.inf)),
    ),
    "IVSN": (
        lambda: IVSN(nn.Conv2d(3, 4, 3, 2, 1), nn.AdaptiveMaxPool2d(1), picture=32, target=8),
        lambda: (rand(1, 3, 48, 64), rand(1, 3, 12, 9)),
    ),
    "GlimpseEvidence": (lambda: Hinting(GlimpseEvidence(3, 8).eval()), lambda: (rand(5, 3), rand(5, 3))),
}
# They take pictures of bytes, from files too, and keep them so: tests/zoom has theirs.
OF_BYTES = {"ZoomAgent", "ZoomEye"}
# They act in a scene of their own, one episode at a time: tests/head has theirs.
OF_SCENES = {"ExploreGain", "HeadAgent", "PerPrice", "Scan", "SceneObserver", "SearchGain"}
TENSORS = OTHERS | {name: (partial(valuing, make), memory) for name, make in ACQUISITIONS.items()}
DECISIONS = {name: (partial(lambda make: Deciding(make()), make), memory) for name, make in DECIDERS.items()}
PARTS = TENSORS | BRANCHING | DECISIONS

# bfloat16 has 8 bits: a value is off by up to 2^-9, 0.2 %. Calibration multiplies logarithms of small scores by large
# parameters, and exploration takes differences of what is nearly equal: digits that are not there then count.
AUTOCAST = dict.fromkeys(("PlaceInformation", "PredictedTargetPosterior", "FovealObservationModel", "VOCUS2"), 0.05)
AUTOCAST["FoldedObservationModel"] = 0.05
AUTOCAST |= dict.fromkeys(EXPLORERS, 0.1)


def make(name: str) -> tuple[str, nn.Module, tuple[Tensor, ...]]:
    module, inputs = PARTS[name]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return name, module(), inputs()


@pytest.fixture(params=PARTS)
def part(request) -> tuple[str, nn.Module, tuple[Tensor, ...]]:
    return make(request.param)


@pytest.fixture(params=TENSORS)
def graph(request) -> tuple[str, nn.Module, tuple[Tensor, ...]]:
    return make(request.param)


def test_all_modules_are_tested():
    """A module that joins the API reference joins this file."""
    modules = {
        name
        for things in entries().values()
        for name, thing in things
        if isclass(thing) and issubclass(thing, nn.Module) and not isabstract(thing)
    }
    assert modules <= {name.split(",")[0] for name in PARTS} | OF_BYTES | OF_SCENES


def test_state_dict(part):
    name, module, inputs = part
    host, other = Host(module), Host(make(name)[1])
    with torch.no_grad():
        for parameter in host.parameters():
            parameter.mul_(1.25)
    file = io.BytesIO()
    torch.save(host.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(host(*inputs), other(*inputs))


def test_copies_are_independent(part):
    _, module, inputs = part
    host = Host(module)
    before = host(*inputs)
    for twin in (copy.deepcopy(host), pickle.loads(pickle.dumps(host))):
        assert torch.equal(twin(*inputs), before)
        with torch.no_grad():
            for tensor in (*twin.parameters(), *twin.buffers()):
                if tensor.is_floating_point():
                    tensor.zero_()
        assert torch.equal(host(*inputs), before)


def test_dtype_is_that_of_the_module(part, device):
    _, module, inputs = part
    expected = Host(module)(*inputs)
    moved = Host(module).to(device, torch.float64)
    result = moved(*(x.to(device, torch.float64) for x in inputs))
    assert result.dtype == torch.float64
    assert result.device.type == device.type
    torch.testing.assert_close(result.cpu().float(), expected, rtol=1e-3, atol=1e-4)


def test_compiles_to_one_graph(graph):
    _, module, inputs = graph
    host = Host(module)
    torch.compiler.reset()
    compiled = torch.compile(host, fullgraph=True, backend="eager")
    torch.testing.assert_close(compiled(*inputs), host(*inputs), rtol=1e-4, atol=1e-5)


def test_exports(graph):
    _, module, inputs = graph
    host = Host(module).requires_grad_(False)
    program = torch.export.export(host, inputs)
    torch.testing.assert_close(program.module()(*inputs), host(*inputs), rtol=1e-4, atol=1e-5)


def test_autocast(part):
    name, module, inputs = part
    host = Host(module).requires_grad_(False)
    expected = host(*inputs)
    with torch.autocast("cpu", torch.bfloat16):
        result = host(*inputs)
    assert bool(torch.isfinite(result).all())
    scale = float(expected.abs().max().clamp(min=1e-6))
    assert float((result.float() - expected).abs().max()) <= AUTOCAST.get(name, 0.02) * scale


@pytest.mark.parametrize("name", TENSORS)
def test_vectorises(name):
    """Over the first input: images, beliefs or scores."""
    _, module, (first, *others) = make(name)
    module.requires_grad_(False)
    many = torch.stack([first, first.flip(-1), first.flip(0)])
    expected = torch.stack([module(each, *others) for each in many])
    together = torch.func.vmap(lambda each: module(each, *others))(many)
    torch.testing.assert_close(together, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("rule", ["kaplan", "product", "sum"])
def test_fusion_vectorises(rule):
    update = getattr(fusion, rule)
    beta, likelihood = 0.5 + rand(6, 4), 0.1 + rand(6, 4)
    expected = torch.stack([update(*pair) for pair in zip(beta, likelihood, strict=True)])
    torch.testing.assert_close(torch.func.vmap(update)(beta, likelihood), expected)


def test_calibration_vectorises():
    observation = model().requires_grad_(False)
    scores, distance = rand(7, 5, 4).softmax(-1), rand(7, 5)
    expected = torch.stack([observation(*pair) for pair in zip(scores, distance, strict=True)])
    torch.testing.assert_close(torch.func.vmap(observation)(scores, distance), expected)


def test_choice_vectorises():
    values, noise = rand(5, 2, 12), rand(5, 2, 12).flip(-1)
    visited = noise > 0.8
    expected = torch.stack([select_fixation(*each) for each in zip(values, visited, noise, strict=True)])
    assert torch.equal(torch.func.vmap(select_fixation)(values, visited, noise), expected)


def test_gradients_of_each_sample():
    """`vmap(grad(...))`, as for influence and per-sample clipping."""
    observation = model().requires_grad_(False)
    scores, distance = rand(7, 4).softmax(-1), rand(7)

    def surprise(one: Tensor, there: Tensor) -> Tensor:
        return -observation(one, there)[2].log()

    every = torch.func.vmap(torch.func.grad(surprise))(scores, distance)
    for one, there, gradient in zip(scores, distance, every, strict=True):
        one = one.clone().requires_grad_()
        torch.testing.assert_close(torch.autograd.grad(surprise(one, there), one)[0], gradient)


def test_gradients_flow_from_the_choice_back_to_gaze_and_scores():
    """Sensor, calibration, fusion and acquisition in one graph."""
    gaze, width = torch.tensor([30.0, 20.0], requires_grad=True), torch.tensor(9.0, requires_grad=True)
    view = semfov.foveate(rand(1, 3, 48, 64), gaze, sigma=width)
    scores = view.mean((-1, -2)) @ rand(3, 4)
    likelihood = model()(scores.softmax(-1), torch.tensor([0.1]))
    beta = fusion.kaplan(beliefs()[:1], likelihood[:, None])
    belief = DirichletBelief(beta)
    acquisition.TargetPosterior(2)(belief, belief.closest == 0).sum().backward()
    for leaf in (gaze, width):
        assert bool(torch.isfinite(leaf.grad).all())
        assert float(leaf.grad.abs().sum()) > 0


def test_observers_and_evidence_are_modules_too():
    """Modules that take detections: state and copies; a belief is what the caller keeps, and no observer changes it."""
    scores, boxes, fixation = look()
    seen = Detections(boxes, scores, torch.ones(1, 2, dtype=torch.bool))
    own = Semantic(4, model().requires_grad_(False))
    twin, start = copy.deepcopy(own), own.start(1, GRID, scores)
    after = own(start, seen, fixation, GRID)
    assert float(start.beta.max()) == float(start.beta.min()) == 0.5
    assert float(after.beta.max()) > 0.5
    with torch.no_grad():
        for parameter in own.parameters():
            parameter.mul_(1.25)
    changed = own(start, seen, fixation, GRID)
    assert torch.equal(twin(start, seen, fixation, GRID).beta, after.beta)
    assert not torch.equal(changed.beta, after.beta)
    twin.load_state_dict(own.state_dict())
    assert torch.equal(twin(start, seen, fixation, GRID).beta, changed.beta)
    # Observers that stand in one another are one module with all their parts.
    whole = Context(
        Target(TargetEvidence(4, 4)),
        ContextPrior(CLASSES, rand(4, 3, 3), rand(4, 4, 3), [0.2, 0.4], weights={"evidence": (0.5, 0.2)}),
    ).eval()
    again = pickle.loads(pickle.dumps(whole))
    assert list(again.state_dict()) == list(whole.state_dict())
    assert {name.split(".")[0] for name in whole.state_dict()} == {"observer", "prior"}
    present = [each(each.start(1, GRID, scores), seen, fixation, GRID, 2).present for each in (whole, again)]
    assert torch.equal(*present)
    evidence = TargetEvidence(4, 4).eval()
    again = pickle.loads(pickle.dumps(evidence))
    assert torch.equal(evidence(seen, fixation, GRID, 2), again(seen, fixation, GRID, 2))


@pytest.mark.parametrize("size", [(48, 64), (200, 300)])
@pytest.mark.parametrize("which", ["image", "gaze", "sigma"])
def test_sensor_vectorises(size, which):
    given = {"image": rand(1, 3, *size), "gaze": torch.tensor([20.0, 30.0]), "sigma": torch.tensor(9.0)}
    many = {"image": rand(4, 1, 3, *size), "gaze": 40 * rand(5, 2), "sigma": 1 + 9 * rand(5)}[which]

    def view(one: Tensor) -> Tensor:
        options = given | {which: one}
        return semfov.foveate(options["image"], options["gaze"], sigma=options["sigma"])

    torch.testing.assert_close(torch.func.vmap(view)(many), torch.stack([view(one) for one in many]))
