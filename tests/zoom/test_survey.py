"""The survey of a picture and the networks that read it, against loops and formulas."""

import pytest
import torch
from torch.nn import functional
from torch.nn.functional import poisson_nll_loss

from semfov.errors import InputError
from semfov.fit.windows_evidence import ANY_CLASS, LookCounts, WindowResult, ZoomExample, fit_survey
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.hint_maps import neighbourhood_mean, neighbourhood_peak, through
from semfov.zoom.hints import Gist
from semfov.zoom.looks import Window, half_steps
from semfov.zoom.networks import network as small_network
from semfov.zoom.survey import Survey
from train.zoom_choice import judge_survey

LATTICE = Lattice.over((256, 192), (64, 64))
CLASSES = 3


def gist(level=0, first=(0, 0)):
    span = LATTICE.span(level)
    shape = min(span, LATTICE.rows), min(span, LATTICE.columns)
    scores = torch.rand(*shape, CLASSES) * (torch.rand(*shape, CLASSES) > 0.7)
    return Gist(level, first, 1, scores, torch.rand(shape) * 4, torch.rand(*shape, CLASSES) > 0.9)


@pytest.fixture
def survey():
    torch.manual_seed(0)
    return Survey(CLASSES)


def looked_at(rule):
    """The labels and looks of a mosaic in which a closer look finds as many objects as `rule` gives for its window."""
    objects = 12
    looks = [WindowResult(Window.on(LATTICE, (0, 0, 0)), gist(), torch.rand(CLASSES), torch.zeros(objects).bool())]
    for window in half_steps(LATTICE):
        if window.level == 0:
            continue
        seen = gist(window.level, window.cells[:2]) if window.level < LATTICE.levels - 1 else None
        looks.append(
            WindowResult(window, seen, torch.rand(CLASSES), torch.arange(objects) < rule(looks[0].gist, window))
        )
    return torch.randint(1, CLASSES + 1, (objects,)), looks


def by_class(labels):
    """The class of each object as 0 and 1, and 1 for any class first."""
    classes = functional.one_hot(labels, CLASSES + 1).float()
    classes[:, 0] = 1
    return classes


def example(rule):
    return ZoomExample.of_results(*looked_at(rule))


def test_rates_depend_on_the_class_of_the_hints_and_on_how_much_the_surroundings_hold(survey):
    """Rates depend on which class a hint is of, not only on how strong it is."""
    look = gist()
    other = Gist(0, (0, 0), 1, look.scores.roll(1, -1), look.size, look.found.roll(1, -1))
    assert torch.equal(look.scores.amax(-1), other.scores.amax(-1))
    assert not torch.allclose(survey.rates(look), survey.rates(other))
    look = gist(1, (0, 0))
    look.scores[0, 0] = 1.0
    scores, found = look.scores.clone(), look.found.clone()
    scores[8, 8] = 0.5
    found[8, 8] = ~found[8, 8].any()
    changed = [Gist(1, (0, 0), 1, scores, look.size, look.found), Gist(1, (0, 0), 1, look.scores, look.size, found)]
    for other in changed:
        assert not torch.equal(survey.rates(look)[..., 0, 0], survey.rates(other)[..., 0, 0])


def test_rates_do_not_depend_on_distant_cells(survey):
    """Beyond the widest neighbourhood a cell matters only through the strongest hint of the look."""
    look = gist(1, (0, 0))
    look.scores[0, 0] = 0.9
    scores = look.scores.clone()
    scores[-1, -1] = 0.5
    changed = Gist(1, (0, 0), 1, scores, look.size, look.found)
    same = survey.rates(look)[0, :, :4, :4]
    assert look.scores.shape[0] >= 16
    torch.testing.assert_close(survey.rates(changed)[0, :, :4, :4], same)


def test_explorations_use_the_survey_and_searches_use_their_class():
    torch.manual_seed(0)
    evidence = GlimpseEvidence(CLASSES).eval().requires_grad_(False)
    evidence.survey.foresight = 0.125
    look = WindowResult(Window.on(LATTICE, (0, 0, 0)), gist(), torch.rand(CLASSES), torch.zeros(1).bool())
    for target, rates in ((0, evidence.survey.rates(look.gist)), (2, evidence.rates(look.gist, torch.tensor([2])))):
        belief = ZoomBelief(LATTICE, evidence, target)
        belief.add(look)
        expected = torch.stack([belief.expected(level) for level in range(1, LATTICE.levels)])
        torch.testing.assert_close(expected, rates[0].exp()[: len(expected), : LATTICE.rows, : LATTICE.columns])
        assert belief.foresight == (0.125 if target == 0 else 0.35)
    with pytest.raises(InputError, match=r"targets: expected classes from 1 on, got \[0, 2\]"):
        GlimpseEvidence(CLASSES).rates(gist(), torch.tensor([0, 2]))


@pytest.mark.parametrize("target", [None, 2])
def test_loss_equals_the_poisson_loss_window_by_window(survey, target):
    """Against sums over the cells of each window, one at a time, and PyTorch's own Poisson likelihood."""
    labels, looks = looked_at(lambda look, window: sum(window.cells) % 5)
    overview = looks[0]
    logs = survey.rates(overview.gist)[0].double()
    survey.double()
    terms = []
    for closer in looks:
        steps = closer.window.level
        if steps == 0:
            continue
        x1, y1, x2, y2 = closer.window.cells
        weight = survey.taper(x2 - x1)
        expected = torch.zeros((), dtype=torch.float64)
        for y in range(y1, y2):
            for x in range(x1, x2):
                if 0 <= y < logs.shape[1] and 0 <= x < logs.shape[2]:
                    expected = expected + weight[y - y1] * weight[x - x1] * logs[steps - 1, y, x].exp()
        counted = closer.found if target is None else closer.found & (labels == target)
        terms.append(poisson_nll_loss(expected, counted.sum().double(), log_input=False, eps=0))
    known = LookCounts.of(overview.gist, looks, by_class(labels), overview.found)
    targets = ANY_CLASS if target is None else torch.tensor([target])
    torch.testing.assert_close(known.loss(survey, logs[None], targets), torch.stack(terms).mean())


def test_objects_that_were_seen_before_are_not_new():
    labels, looks = looked_at(lambda look, window: 3)
    for seen, new in ((0, 3), (2, 1), (12, 0)):
        counts = LookCounts.of(looks[0].gist, looks, by_class(labels), torch.arange(12) < seen).counts
        assert {int(n) for _, _, numbers in counts.values() for n in numbers[:, 0]} == {new}
        # The first objects count, by their classes.
        expected = torch.bincount(labels[seen:3] - 1, minlength=CLASSES).float()
        assert all(torch.equal(row[1:], expected) for _, _, numbers in counts.values() for row in numbers)


def test_fitting_improves_predictions_on_held_out_mosaics():
    """The number of objects in a window follows only from its hints of class 2."""
    torch.manual_seed(1)

    def rule(look, window):
        x1, y1, x2, y2 = (max(n, 0) for n in window.cells)
        return int((look.scores[y1:y2, x1:x2, 1] > 0).sum()) // 4

    examples, held = [example(rule) for _ in range(4)], [example(rule)]
    survey = Survey(CLASSES)
    overview, *_ = before = judge_survey(survey, held)
    fit_survey(survey, examples, 40, batch=2)
    assert judge_survey(survey, held)[overview] < before[overview] - 0.2


@pytest.mark.parametrize("shape", [(5,), (1, 5), (40, 5), (3, 6, 5), (2, 3, 6, 5)])
def test_a_network_called_layer_by_layer_equals_the_module(shape, device):
    torch.manual_seed(0)
    network, values = small_network(5, 16, 3).to(device), torch.randn(shape, device=device)
    expected = network(values)
    torch.testing.assert_close(through(network, values), expected)


def test_a_network_called_layer_by_layer_has_the_gradient_of_the_module():
    torch.manual_seed(0)
    network, values = small_network(5, 16, 3), torch.randn(40, 5)
    (gradient,) = torch.autograd.grad(through(network, values).sum(), network[0].weight)
    (wanted,) = torch.autograd.grad(network(values).sum(), network[0].weight)
    torch.testing.assert_close(gradient, wanted)


@pytest.mark.parametrize("side", [3, 9, 17])
@pytest.mark.parametrize("shape", [(2, 12, 10), (1, 1, 5), (4, 32, 32)])
def test_means_and_peaks_of_neighbourhoods_equal_pooling(side, shape, device):
    values = torch.randn(shape, device=device)
    settings = {"kernel_size": side, "stride": 1, "padding": side // 2}
    expected = functional.avg_pool2d(values[:, None], **settings)[:, 0]
    torch.testing.assert_close(neighbourhood_mean(values, side), expected)
    expected = functional.max_pool2d(values[:, None], **settings)[:, 0]
    torch.testing.assert_close(neighbourhood_peak(values, side), expected, rtol=0, atol=0)
