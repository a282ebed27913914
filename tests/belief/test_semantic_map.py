"""The semantic map: loops over cells, the closest look, cells without detections, gradients, its fit."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from semfov import Detections, FovealObservationModel, Grid
from semfov.belief.observers import SemanticMap
from semfov.data.scene import Annotation
from semfov.errors import DataError
from semfov.fit.cells import fit_cells, map_loss, mean_map_loss
from semfov.fit.samples import AnnotatedLooks, annotated_looks

GRID = Grid(5, 4, (100, 80))
FIXATIONS = GRID.centres[torch.tensor([0, 13, 7])]
NO_TARGETS = torch.zeros(0, dtype=torch.long)
MISS, EXPONENT, BACKGROUND = CELL = (0.05, 1.4, 0.6)


def model(**settings):
    """A model with three levels and random parameters."""
    generator = torch.Generator().manual_seed(3)
    alpha = (torch.randn(4, 3, 4, generator=generator, dtype=torch.float64) / 2).exp()
    return FovealObservationModel(alpha, [0.2, 0.5], ["cup", "cat", "dog"], **{"cell": CELL, **settings})


@pytest.fixture
def looks(random_looks):
    return random_looks(GRID, looks=3, most=4, components=4, dtype=torch.float64)


def watch(observer, looks, order=(0, 1, 2)):
    belief = observer.start(1, GRID, looks.scores)
    for number in order:
        part = slice(number, number + 1)
        belief = observer(belief, looks[part], FIXATIONS[part].double(), GRID)
    return belief


def covers(box, cell):
    left, top = cell % 5 * 20, cell // 5 * 20
    return box[0] < left + 20 and box[2] > left and box[1] < top + 20 and box[3] > top


@pytest.mark.parametrize("precision", [torch.bfloat16, torch.float16])
def test_ratios_beyond_half_precision_are_kept_by_automatic_mixed_precision(looks, precision):
    """The largest number of float16 is 65,504, and a detection may be a million times as likely as background."""
    exact = looks.scores.float().clone()
    exact[..., 0] = 1e-6
    seen = replace(looks, scores=exact / exact.sum(-1, keepdim=True))
    observer = SemanticMap(FovealObservationModel.identity(["cup", "cat", "dog"], [0.2]).requires_grad_(False))
    expected = observer.weigh(seen, FIXATIONS, GRID).ratio
    assert expected.max() > 1e5
    with torch.autocast("cpu", precision):
        assert torch.equal(observer.weigh(seen, FIXATIONS, GRID).ratio, expected)


def test_a_cell_takes_the_likelihood_of_its_closest_look(looks):
    fom = model().requires_grad_(False)
    got = watch(SemanticMap(fom), looks).class_probabilities()[0]
    offset = torch.cdist(GRID.centres.double(), FIXATIONS.double()) / 100
    for cell in range(20):
        look = int(offset[cell].argmin())
        expected = [BACKGROUND] + [MISS] * 3
        for box, scores, real in zip(looks.boxes[look], looks.scores[look], looks.mask[look], strict=True):
            if real and covers(box.tolist(), cell):
                middle = (box[:2] + box[2:]) / 2 - 0.5
                calibrated = fom.calibrate(scores, (middle - FIXATIONS[look].double()).norm() / 100)
                for k in (1, 2, 3):
                    expected[k] += float(calibrated[k] / calibrated[0])
        expected[1:] = [value**EXPONENT for value in expected[1:]]
        shares = [value / sum(expected) for value in expected]
        # The prior counts as a thousandth of a look.
        assert got[cell].tolist() == pytest.approx(shares, abs=1e-3), cell


def test_a_farther_look_changes_no_cell_and_order_matters_only_in_ties(looks):
    observer = SemanticMap(model().requires_grad_(False))
    belief = watch(observer, looks)
    again = watch(observer, looks, (0, 1, 2, 1, 0))
    assert torch.equal(again.beta, belief.beta)
    offset = torch.cdist(GRID.centres, FIXATIONS)
    is_tied = (offset == offset.amin(1, keepdim=True)).sum(1) > 1
    assert torch.equal(watch(observer, looks, (2, 1, 0)).beta[0, ~is_tied], belief.beta[0, ~is_tied])
    torch.testing.assert_close(belief.closest[0], offset.amin(1).double() / 100)


def test_an_unseen_cell_is_as_one_without_detections():
    observer = SemanticMap(model().requires_grad_(False))
    expected = torch.tensor([BACKGROUND, *3 * [MISS**EXPONENT]], dtype=torch.float64)
    torch.testing.assert_close(observer.unseen(torch.zeros(1).double()), expected / expected.sum())
    nothing = Detections(torch.zeros(1, 0, 4), torch.zeros(1, 0, 4), torch.zeros(1, 0, dtype=torch.bool))
    seen = watch(observer, nothing, (0,))
    torch.testing.assert_close(
        seen.class_probabilities()[0, 7].double(), observer.unseen(torch.zeros(1).double()), atol=1e-3, rtol=0
    )


def test_a_belief_fades_towards_the_prior(looks):
    observer = SemanticMap(model().requires_grad_(False))
    belief = watch(observer, looks)
    look = observer.weigh(looks[:1], FIXATIONS[:1].double(), GRID)
    visited = torch.zeros(1, 20, dtype=torch.bool)
    assert observer.fade(belief, look, 1.0, visited) is belief
    faded = observer.fade(belief, look, 0.5, visited)
    start = observer.start(1, GRID, looks.scores)
    torch.testing.assert_close(faded.beta, (belief.beta + start.beta) / 2)
    # So far away, a look counts half as much.
    torch.testing.assert_close(faded.closest - belief.closest, torch.full_like(belief.closest, math.log(2) / 6))


def test_gradients_reach_the_numbers_of_cells_and_alpha(looks):
    fom = model()
    mapped = AnnotatedLooks(0, looks, FIXATIONS.double(), GRID, torch.rand(20, 4) < 0.5, NO_TARGETS)

    def loss(cell, alpha):
        fom.log_cell.data, fom.log_alpha.data = cell, alpha
        parameters = {"log_cell": cell, "log_alpha": alpha}
        observer = SemanticMap(fom)
        return torch.func.functional_call(
            _Loss(observer, mapped), {f"observer.model.{name}": value for name, value in parameters.items()}
        )

    inputs = fom.log_cell.detach().clone().requires_grad_(), fom.log_alpha.detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-4, fast_mode=True)


class _Loss(torch.nn.Module):
    def __init__(self, observer, mapped):
        super().__init__()
        self.observer, self.mapped = observer, mapped

    def forward(self):
        return map_loss(self.observer, self.mapped, torch.arange(3))


def test_the_fit_finds_how_often_cells_hold_nothing(looks):
    """Where nothing is detected, the probability of background becomes the share of cells that hold nothing."""
    nothing = Detections(looks.boxes, looks.scores, torch.zeros_like(looks.mask))
    answers = torch.zeros(20, 4, dtype=torch.bool)
    answers[:15, 0] = answers[15:, 2] = True
    mapped = AnnotatedLooks(0, nothing, FIXATIONS.double(), GRID, answers, NO_TARGETS)
    fom = model()
    others = {key: value.clone() for key, value in fom.state_dict().items() if key != "log_cell"}
    before = mean_map_loss(fom, [mapped])
    fit_cells(fom, [mapped])
    assert mean_map_loss(fom, [mapped]) < before
    share = SemanticMap(fom).unseen(torch.zeros(1).double())[0]
    assert float(share.detach()) == pytest.approx(0.75, abs=1e-3)
    assert all(torch.equal(fom.state_dict()[key], value) for key, value in others.items())
    assert all(parameter.grad is None for parameter in fom.parameters())


def test_numbers_stay_finite_where_looks_tell_all_cells_apart():
    """Scores leave no doubt, so that the likelihood grows with the exponent without end."""
    fom = FovealObservationModel.identity(["a", "b"], [0.2])
    grid = Grid(4, 4, (40, 40))
    box = torch.tensor([[[0.0, 0.0, 19.0, 19.0]]]).expand(8, 1, 4)
    covered = grid.footprint(box[0])[0]
    photographs = []
    for name in (1, 2) * 4:
        scores = torch.tensor([0.001, 0.381, 0.381])
        scores[name] = 0.618
        answers = torch.zeros(16, 3, dtype=torch.bool)
        answers[:, 0], answers[:, name] = ~covered, covered
        seen = Detections(box, scores.expand(8, 1, 3), torch.ones(8, 1, dtype=torch.bool))
        photographs.append(AnnotatedLooks(0, seen, grid.centres[:8], grid, answers, NO_TARGETS))
    fit_cells(fom, photographs)
    miss, exponent, background = fom.log_cell.exp().tolist()
    assert 0 < miss < 1
    assert 0 < background < 1
    assert 2 < exponent < 1000
    assert mean_map_loss(fom, photographs) < 0.01


def test_photographs_without_objects_are_left_out():
    boxes = torch.tensor([[0.0, 0.0, 50.0, 50.0]])
    one = Annotation(boxes, torch.tensor([1]), torch.tensor([False]), (100, 80))
    none = Annotation(boxes[:0], one.labels[:0], one.crowd[:0], one.size)
    held = {0: none, 1: one}
    scenes = SimpleNamespace(annotation=held.__getitem__, classes=("cup", "cat"))
    looks = [(index, index, FIXATIONS) for index in held]
    (only,) = annotated_looks(scenes, looks, (5, 4))
    assert (only.photograph, only.detections) == (1, 1)
    assert only.answers.sum(0).tolist() == [11, 9, 0]
    assert only.targets.tolist() == [1]
    assert torch.equal(only.goal, only.answers[None, :, 1])
    (large,) = annotated_looks(scenes, looks, (5, 4), max_target_area=0.2)
    assert not len(large.targets)
    (full,) = annotated_looks(scenes, looks, (1, 1))  # a search for it would end at once
    assert not len(full.targets)


def test_a_fit_needs_a_photograph():
    with pytest.raises(DataError, match="none of the photographs contains an object"):
        fit_cells(model(), [])
