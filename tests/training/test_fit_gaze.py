"""`python -m train.fit_gaze`: its gradient against finite differences, and the effect of training."""

import json
from dataclasses import replace
from itertools import pairwise

import pytest
import torch
from torch.nn import functional as F

from eval.search import main as search
from semfov import ActivePerception, DataError, Detector, Eye, Foveation, Grid, Selection, policies
from semfov.data.scene import Annotation, Scene
from semfov.detection.scores import Candidates
from semfov.gaze.learned import LearnedGaze
from semfov.training.gaze import FitGazeConfig, first_model, judge, learning_rate, train
from semfov.training.gaze_episodes import Relaxation, Searches, backpropagate, found_at, log_share, unroll
from train.fit_gaze import main

SIDE, CELL = 48, 12


class Textures(Detector):
    """A detector of fine texture: a box for every cell, with a high score only where the texture is sharp."""

    def __init__(self) -> None:
        super().__init__("textures", ("red", "green"), (SIDE, SIDE), selection=Selection(threshold=0.0))

    def propose(self, canvas):
        kernel = canvas.new_tensor([[0.0, -1.0, 0.0], [-1.0, 4.0, -1.0], [0.0, -1.0, 0.0]]).expand(3, 1, 3, 3)
        energy = F.avg_pool2d(F.conv2d(canvas, kernel, padding=1, groups=3).square(), CELL).flatten(2).mT
        corner = Grid(SIDE // CELL, SIDE // CELL, (SIDE, SIDE)).edges.to(canvas)
        objectness = (2 * energy.sum(-1) - 2).sigmoid()
        return Candidates(corner.expand(len(canvas), -1, -1), (3 * energy[..., :2] - 1).sigmoid(), objectness)


def picture(generator: torch.Generator, **cells: int) -> torch.Tensor:
    """Dim noise with patches of red and of green texture in the given cells."""
    image = 0.1 * torch.rand(3, SIDE, SIDE, generator=generator, dtype=torch.float64)
    for colour, cell in cells.items():
        channel = ("red", "green").index(colour)
        row, column = divmod(cell, SIDE // CELL)
        patch = torch.rand(CELL, CELL, generator=generator, dtype=torch.float64)
        image[channel, row * CELL : (row + 1) * CELL, column * CELL : (column + 1) * CELL] = patch
    return image


class Pictures:
    """Scenes with a green target in the upper row, which is not drawn, and a red object below it."""

    classes = ("red", "green")
    fingerprint = "pictures"

    def __init__(self, count: int) -> None:
        self.ids = list(range(count))

    def __len__(self):
        return len(self.ids)

    def _cells(self, index):
        return 4 + (5 * index) % 12, index % 4

    def __getitem__(self, index):
        image = picture(torch.Generator().manual_seed(index), red=self._cells(index)[0]).float()
        annotation = self.annotation(index)
        return Scene(index, str(index), image, annotation.boxes, annotation.labels)

    def annotation(self, index):
        boxes = Grid(4, 4, (SIDE, SIDE)).edges[list(self._cells(index))]
        return Annotation(boxes, torch.tensor([1, 2]), torch.zeros(2, dtype=torch.bool), (SIDE, SIDE))

    def targets(self, index):
        return [2]


def toy(sigma: float = 8.0) -> tuple[Eye, Searches, torch.Tensor]:
    """Three searches in one picture, in double precision."""
    generator = torch.Generator().manual_seed(3)
    eye = Eye(Foveation(sigma, levels=3), Textures(), reference=SIDE).double()
    view = eye.open(picture(generator, red=6, green=13)[None])
    grid = Grid(4, 4, (SIDE, SIDE))
    goal = torch.zeros(3, 16, dtype=torch.bool)
    goal[0, 6] = goal[1, 13] = goal[2, 13] = True
    searches = Searches(
        view, grid, torch.tensor([1, 2, 2]), goal, torch.tensor([0, 3, 8]), torch.tensor([1, 2]), goal[:2]
    )
    return eye, searches, torch.rand(4, 3, 16, generator=generator)


def some_gaze(seed: int = 0) -> LearnedGaze:
    torch.manual_seed(seed)
    gaze = LearnedGaze(4).double()
    torch.nn.init.normal_(gaze.network[-1].weight, std=0.3)
    return gaze


SOFT = Relaxation(shifts=4, window=4, others=0.0, hard=False)


def loss_of(gaze, eye, searches, noise, how) -> torch.Tensor:
    losses = []
    unroll(gaze, eye, searches, noise, how, losses.append)
    return torch.stack(losses).sum()


@pytest.mark.parametrize("posterior", [0.0, 0.5])
def test_gradient_equals_finite_differences(posterior):
    eye, searches, noise = toy()
    eye.sensor.log_sigma.requires_grad_(True)
    image = picture(torch.Generator().manual_seed(3), red=6, green=13)[None]
    gaze, how = some_gaze(), replace(SOFT, posterior=posterior)
    parameters = [*gaze.parameters(), eye.sensor.log_sigma]

    def loss() -> torch.Tensor:
        return loss_of(gaze, eye, replace(searches, view=eye.open(image)), noise, how)

    gradient = torch.autograd.grad(loss(), parameters)
    assert all(bool((g != 0).any()) for g in gradient)
    generator, step = torch.Generator().manual_seed(0), 1e-6
    for number in range(6):
        if number:
            way = [torch.randn(p.shape, generator=generator, dtype=p.dtype) for p in parameters]
        else:  # only the width of the fovea
            way = [torch.zeros_like(p) for p in parameters[:-1]] + [torch.ones_like(parameters[-1])]
        ends = []
        for sign in (1, -1):
            with torch.no_grad():
                for p, d in zip(parameters, way, strict=True):
                    p += sign * step * d
                ends.append(float(loss()))
                for p, d in zip(parameters, way, strict=True):
                    p -= sign * step * d
        expected = (ends[0] - ends[1]) / (2 * step)
        slope = sum(float((g * d).sum()) for g, d in zip(gradient, way, strict=True))
        assert slope == pytest.approx(expected, rel=1e-5, abs=1e-7)


def belief_loss(gaze, eye, searches, noise, hard) -> torch.Tensor:
    """The loss of the belief, which depends on the policy only through the views."""
    how = replace(SOFT, hard=hard)
    return loss_of(gaze, eye, searches, noise, replace(how, posterior=1.0)) - loss_of(
        gaze, eye, searches, noise, replace(how, posterior=0.0)
    )


@pytest.mark.parametrize("hard", [True, False])
def test_the_gradient_flows_only_through_the_fovea(hard):
    for sigma, flows in ((8.0, True), (1e9, False)):
        eye, searches, noise = toy(sigma)
        gaze = some_gaze()
        gradient = torch.autograd.grad(belief_loss(gaze, eye, searches, noise, hard), list(gaze.parameters()))
        largest = max(float(g.abs().max()) for g in gradient)
        assert largest > 1e-4 if flows else largest < 1e-9


def test_windows_truncate_the_gradient_but_not_the_loss():
    eye, searches, noise = toy()
    gaze, how = some_gaze(), Relaxation(shifts=4, window=4)
    whole = backpropagate(gaze, eye, searches, noise, how)
    gradients = [p.grad.clone() for p in gaze.parameters()]
    gaze.zero_grad()
    cut = backpropagate(gaze, eye, searches, noise, replace(how, window=1), share=0.5)
    assert cut == pytest.approx(whole / 2)
    assert any(not torch.allclose(2 * p.grad, g) for p, g in zip(gaze.parameters(), gradients, strict=True))
    direct = torch.autograd.grad(loss_of(gaze, eye, searches, noise, how), list(gaze.parameters()))
    for mine, theirs in zip(gradients, direct, strict=True):
        torch.testing.assert_close(mine, theirs)


def test_log_share_is_the_weight_of_goal_cells():
    weights = torch.tensor([[0.1, 0.2, 0.3, 0.4], [1.0, 1.0, 1.0, 1.0]])
    goal = torch.tensor([[True, False, True, False], [False] * 4])
    torch.testing.assert_close(log_share(weights.log(), goal), torch.tensor([0.4, 1.0]).log())


def test_searches_match_those_of_the_agent():
    eye, searches, _ = toy()
    gaze = some_gaze(1)
    with torch.no_grad():
        found = found_at(gaze, eye, searches, torch.rand(8, 3, 16, generator=torch.Generator().manual_seed(0)))
    image = picture(torch.Generator().manual_seed(3), red=6, green=13)
    strategy = gaze.observer(3), policies.Learned(gaze)
    agent = ActivePerception(eye, strategy, strategy, grid=(4, 4))
    for row in range(3):
        cell = int(searches.goal[row].nonzero())
        boxes = searches.grid.edges[cell][None]
        with torch.no_grad():
            path = agent.search(
                image, int(searches.targets[row]), start=int(searches.start[row]), shifts=8, boxes=boxes
            )
        assert path.found
        assert len(path) - 1 == int(found[row])


@pytest.fixture
def config(tmp_path):
    return FitGazeConfig(
        columns=4, rows=4, width=4, shifts=3, window=3, steps=20, photographs=1, searches=4, rate=0.05, out=tmp_path
    )


@pytest.fixture
def eye():
    return Eye(Foveation(5.0, levels=3), Textures(), reference=SIDE).requires_grad_(False)


@pytest.mark.slow
def test_training_finds_targets_earlier(config, eye):
    scenes, metadata = Pictures(12), {}
    learned, losses = train(config, eye, scenes, range(12), metadata)
    assert len(losses) == config.steps
    assert sum(losses[-6:]) < 0.8 * sum(losses[:6])
    start = first_model(config, metadata)
    longer = replace(config, shifts=6)
    found = {gaze: judge(longer, gaze, eye, scenes, range(12), "judging").float().mean() for gaze in (start, learned)}
    assert found[learned] < 0.8 * found[start]


@pytest.mark.usefixtures("one_thread")
def test_a_resumed_run_ends_with_the_same_weights(config, eye):
    scenes = Pictures(6)
    whole, losses = train(replace(config, steps=6, out=config.out / "whole"), eye, scenes, range(6), {})

    class Killed(Exception):
        pass

    class Dying(Pictures):
        calls = 0

        def __getitem__(self, index):
            self.calls += 1
            if self.calls > 3:  # in the fourth step
                raise Killed
            return super().__getitem__(index)

    part = replace(config, steps=6, save_every=2, out=config.out / "part")
    with pytest.raises(Killed):
        train(part, eye, Dying(6), range(6), {})
    again, same = train(part, eye, scenes, range(6), {})
    assert same == losses
    for name, tensor in whole.state_dict().items():
        assert torch.equal(tensor, again.state_dict()[name]), name
    with pytest.raises(DataError, match="other settings"):
        train(part, eye, scenes, range(6), {"another": 1})


def test_the_learning_rate_rises_and_then_decays(config):
    rates = [learning_rate(replace(config, steps=100), step) for step in range(100)]
    assert rates[:5] == pytest.approx([0.01, 0.02, 0.03, 0.04, 0.05])
    assert rates[5] == pytest.approx(0.05)
    assert all(a > b for a, b in pairwise(rates[5:]))
    assert rates[-1] < 1e-4


@pytest.mark.weights
@pytest.mark.slow
def test_the_command_writes_a_gaze_that_a_search_uses(tmp_path, capsys):
    threads = torch.get_num_threads()
    call = ["--data.limit", "4", "--data.min_instances", "1", "--holdout", "2", "--steps", "2", "--shifts", "2"]
    assert main([*call, "--photographs", "1", "--learn_sigma", "true", "--out", str(tmp_path)]) == 0
    torch.set_num_threads(threads)
    gaze = LearnedGaze.from_pretrained(tmp_path / "yolov3-tiny.safetensors")
    assert gaze.metadata["detector"]["name"] == "yolov3-tiny"
    assert gaze.metadata["sensor"]["sigma"] != 100.0
    assert json.loads((tmp_path / "judged.json").read_text())["found_at"].keys() == {"start", "learned"}
    assert "gain" in (tmp_path / "report.md").read_text()
    assert "written:" in capsys.readouterr().out
    # The search uses the learned width of the fovea.
    found = [
        "--sensor.sigma",
        str(gaze.metadata["sensor"]["sigma"]),
        "--gaze_model",
        str(tmp_path / "yolov3-tiny.safetensors"),
    ]
    small = [
        "--data.limit",
        "1",
        "--belief.columns",
        "3",
        "--belief.rows",
        "3",
        "--protocol.shifts",
        "3",
        "--workers",
        "1",
    ]
    places = ["--out", str(tmp_path / "run"), "--cache", str(tmp_path / "cache")]
    assert search([*found, *small, *places, "--policies", "[learned,random]", "--protocol.starts", "2"]) == 0
    torch.set_num_threads(threads)
    assert "| learned " in (tmp_path / "run" / "summary.md").read_text()
