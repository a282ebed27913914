"""A camera or a video: the belief goes on from frame to frame, fades, and is that of a search where nothing changes."""

import math
from itertools import pairwise

import numpy as np
import pytest
import torch

from semfov import ActivePerception, Eye, Foveation, Grid
from semfov.belief import ContextPrior, MapEvidence, TargetEvidence
from semfov.belief.look_features import class_features, nothing_seen
from semfov.belief.observers import Context, LearnedMap, Semantic, Target
from semfov.belief.target_evidence import Thresholds
from semfov.detection import Candidates, Detections, Detector
from semfov.episode import Forgetting
from semfov.errors import InputError
from semfov.gaze.policies import Closer, NonPredictive, Random

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


def scene(x, y=8, size=24):
    """Grey, with a green square."""
    picture = torch.full((3, 120, 160), 0.4)
    picture[:, y : y + size, max(x, 0) : max(x + size, 0)] = torch.tensor([0.1, 0.9, 0.1])[:, None, None]
    return picture


def learned(kind):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        model = kind(6, 5, components=3)
        torch.nn.init.normal_(model.prior)
    return model


def observers():
    context = ContextPrior(["red", "green"], torch.zeros(3, 2, 2), torch.zeros(3, 3, 2), [0.1])
    return {
        "semantic": Semantic(3),
        "closest": Semantic(3, memory="closest"),
        "target": Target(learned(TargetEvidence)),
        "context": Context(Target(learned(TargetEvidence)), context, (1.0, 1.0)),
        "map": LearnedMap(learned(MapEvidence)),
    }


def agent_with(observer, policy=None):
    eye = Eye(Foveation(40.0), Squares(), reference=160.0)
    policy = policy or NonPredictive()
    mapper = Semantic(3) if observer.by_target else observer
    return ActivePerception(eye, (observer, policy), (mapper, Random()), grid=(8, 6)).eval()


def tensors(belief):
    found = []
    belief.map(lambda tensor: found.append(tensor) or tensor)
    return found


@pytest.mark.parametrize("name", observers())
def test_a_still_picture_at_rate_zero_is_an_ordinary_search(name, one_thread):
    """To the bit: cells, values, belief, and which cells the gaze is kept from."""
    agent, image = agent_with(observers()[name]), scene(100, 80)
    live = agent.live("green", rate=0, seed=5)
    with torch.inference_mode():
        searched = agent.search(image, "green", seed=5, shifts=11, boxes=torch.tensor([[-9.0, -9, -1, -1]]))
    moments = [live.step(image) for _ in range(12)]
    assert [moment.cell for moment in moments] == searched.cells.tolist()
    for moment, posterior, seen in zip(moments, searched.posterior, searched.detections, strict=True):
        assert torch.equal(moment.probability, posterior)
        assert torch.equal(moment.detections.boxes, seen.boxes)
        assert torch.equal(moment.visited.nonzero()[:, 0], searched.cells[: moment.number + 1].sort().values)
    assert set(moments[0].seconds) == {"open", "foveate", "detect", "weigh", "update belief", "choose"}


def test_an_exploration_at_rate_zero_is_an_ordinary_one(one_thread):
    model = learned(MapEvidence)
    agent = agent_with(Semantic(3))
    agent = ActivePerception(
        agent.eye, (Semantic(3), NonPredictive()), (LearnedMap(model), Closer(0.2)), grid=(8, 6)
    ).eval()
    live, image = agent.live(rate=0, start=3), scene(60, 60)
    with torch.inference_mode():
        explored = agent.explore(image, start=3, shifts=6, until=0)
    for cell, map_, _ in zip(explored.cells, explored.probabilities, range(7), strict=True):
        moment = live.step(image)
        assert moment.cell == cell
        assert torch.equal(moment.belief.class_probabilities()[0], map_)
        assert torch.equal(moment.probability, 1 - map_[:, 0])


@pytest.mark.parametrize("name", observers())
def test_nothing_fades_at_rate_zero_and_little_is_kept_at_a_great_one(name):
    observer, grid = observers()[name], Grid(8, 6, SIZE)
    eye, like = agent_with(observer).eye, torch.zeros(1)
    fixation = grid.centres[[20]]
    seen = eye(scene(100, 80), fixation)
    look = observer.weigh(seen, fixation, grid, 2)
    belief = observer.update(observer.start(1, grid, like), look)
    visited = torch.zeros(1, 48, dtype=torch.bool)
    for before, after in zip(tensors(belief), tensors(observer.fade(belief, look, 1.0, visited)), strict=True):
        assert torch.equal(before, after)
    # What is left of it adds next to nothing to the next look.
    fresh = observer.update(observer.start(1, grid, like), look)
    again = observer.update(observer.fade(belief, look, 1e-7, visited), look)
    torch.testing.assert_close(again.probability(2), fresh.probability(2), atol=1e-4, rtol=1e-4)


def test_dirichlet_parameters_return_to_the_prior_exponentially():
    """β − β₀ after n looks that see nothing is e^(−rn) times as large."""
    agent = agent_with(Semantic(3, prior=0.25))
    live = agent.live("green", rate=0.2, start=0)
    first = live.step(scene(4)).belief.beta
    assert first.max() > 0.6
    for _ in range(5):
        last = live.step(torch.full((3, 120, 160), 0.4)).belief.beta
    torch.testing.assert_close(last - 0.25, math.exp(-1) * (first - 0.25), atol=1e-6, rtol=1e-5)


def test_learned_evidence_returns_to_that_of_a_look_that_shows_nothing():
    observer = Target(learned(TargetEvidence))
    grid, distance = Grid(8, 6, SIZE), torch.rand(4)
    fixation = torch.tensor([[10.0, 20.0]])
    none = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 3), torch.zeros(1, 0, dtype=torch.bool))
    features = class_features(none, fixation, grid, torch.tensor([1]))[0, 0]
    torch.testing.assert_close(nothing_seen(grid.distance(fixation)[0]), features)
    unseen = observer.model.unseen(distance)
    torch.testing.assert_close(unseen, observer.model.evidence(nothing_seen(torch.ones(1)))[0])
    look = observer.weigh(none, fixation, grid, 1)
    belief = observer.update(observer.start(1, grid, distance), look)
    for _ in range(30):
        belief = observer.fade(belief, look, math.exp(-0.5), belief.visited)
    torch.testing.assert_close(belief.nearest, unseen.expand_as(belief.nearest), atol=1e-4, rtol=1e-4)
    # A look counts by exp(-6 d): what fades as much as by distance is as far away.
    torch.testing.assert_close((-6 * (belief.closest - look.distance)).exp(), torch.full((1, 48), math.exp(-15)))


def test_what_left_the_view_fades_and_the_target_is_followed():
    """A square moves from the left to the right, and the most probable cell goes with it."""
    live = agent_with(Semantic(3)).live("green", rate=0.3, seed=1)
    there, grid = [], Grid(8, 6, SIZE)
    for x in [8] * 12 + list(range(8, 129, 8)) + [128] * 12:
        moment = live.step(scene(x))
        there.append((x, moment))
    begun, ended = there[11][1], there[-1][1]
    left = grid.footprint(torch.tensor([[8.0, 8, 32, 32]]))[0]
    right = grid.footprint(torch.tensor([[128.0, 8, 152, 32]]))[0]
    assert left[begun.probability.argmax()]
    assert right[ended.probability.argmax()]
    assert begun.probability[left].max() > 0.7
    assert ended.probability[left & ~right].max() < 0.45
    still = agent_with(Semantic(3)).live("green", rate=0, seed=1)
    for x, _ in there:
        kept = still.step(scene(x))
    assert kept.probability[left].max() > 0.7, "without a rate nothing is forgotten"
    # The gaze goes on from where it was.
    for (_, before), (_, after) in pairwise(there):
        assert after.cell == before.next_cell


def test_cells_are_free_again_when_half_is_forgotten():
    live, picture = (
        agent_with(Semantic(3)).live("green", rate=math.log(2) / 4.5, start=0),
        torch.full((3, 120, 160), 0.4),
    )
    cells = []
    for _ in range(40):
        moment = live.step(picture)
        cells.append(moment.cell)
        assert set(moment.visited.nonzero()[:, 0].tolist()) == set(cells[-5:])
    assert len(set(cells)) < 40


def test_where_every_cell_was_fixated_the_gaze_goes_to_the_oldest():
    agent = agent_with(Semantic(3))
    agent.columns, agent.rows = 3, 2
    live = agent.live("green", rate=0)
    cells = [live.step(scene(50)).cell for _ in range(18)]
    assert sorted(cells[:6]) == list(range(6))
    assert cells == cells[:6] * 3


def test_ages():
    age = torch.tensor([[0.0, 3, 4, torch.inf], [0, 1, 2, 3]])
    assert Forgetting(math.log(2) / 3.5).visited(age).tolist() == [
        [True, True, False, False],
        [True, True, True, False],
    ]
    for rate in (-0.1, math.nan, True, "fast"):
        with pytest.raises(InputError, match="rate: expected a number from 0"):
            Forgetting(rate)


class Deciding(Semantic):
    """An observer by which a search may decide."""

    thresholds = Thresholds(0.6, 0.01)


def test_decisions_of_the_moment():
    live = agent_with(Deciding(3)).live("green", rate=0.2, start=9)
    outcomes = [live.step(scene(8)).decision for _ in range(8)]
    assert outcomes[-1].outcome == "found"
    x1, y1, x2, y2 = outcomes[-1].box.tolist()
    assert x1 < 20 < x2
    assert y1 < 20 < y2
    gone = [live.step(torch.full((3, 120, 160), 0.4)).decision for _ in range(30)]
    assert gone[-1].outcome != "found"
    assert gone[-1].probability < 0.5
    assert agent_with(Semantic(3)).live("green").step(scene(8)).decision is None
    assert agent_with(Deciding(3)).live("green", confirm=1.0).thresholds == Thresholds(1.0, 0.01)


def test_frames_of_any_kind_and_of_one_size():
    live = agent_with(Semantic(3)).live("green")
    live.step((scene(8).permute(1, 2, 0).numpy() * 255).astype(np.uint8))
    with pytest.raises(InputError, match=r"frame: expected 160 × 120 pixels, the size of the first frame, got 80 × 60"):
        live.step(torch.rand(3, 60, 80))
    with pytest.raises(InputError, match="frame: expected one picture"):
        live.step(torch.rand(2, 3, 120, 160))
    for wrong in ({"target": "gren"}, {"start": 48}, {"seed": -1}, {"rate": -1}, {"confirm": 50}):
        with pytest.raises(InputError, match=f"^{next(iter(wrong))}: "):
            agent_with(Semantic(3)).live(**wrong)


class Stubborn(Semantic):
    """An observer that was written for scenes that stand still."""

    fade = Semantic.__mro__[1].fade


def test_observers_that_cannot_forget_say_so():
    with pytest.raises(InputError, match="observer: expected one whose belief can fade, got Stubborn"):
        agent_with(Stubborn(3)).live("green").step(scene(8))
