"""One of the detections shows the object of a cell: hypotheses enumerated, loops over cells, gradients, training."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch

from semfov import Detections, FovealObservationModel, Grid
from semfov.belief.association import one_of, refuted
from semfov.belief.observers import AnyOf, SemanticSearch
from semfov.belief.observers.semantic_search import SearchEvidence
from semfov.belief.prior import Prior
from semfov.fit.samples import AnnotatedLooks
from semfov.fit.through_belief import fit_through_belief, landing_loss
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.strategy import Strategy
from tests.refusals import refused

GRID = Grid(5, 4, (100, 80))
FIXATIONS = GRID.centres[torch.tensor([0, 13, 7])]
EDGES = [0.2, 0.5]
CLASSES = ["cup", "cat", "dog"]


def model(dtype=torch.float64, **settings):
    """A model with three levels and random parameters."""
    generator = torch.Generator().manual_seed(3)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64).to(dtype)

    parameters = {
        "log_prior": draw(4, 3),
        "exponents": draw(3).exp(),
        "miss_odds": (draw(4, 3) - 1).exp(),
        "refutation": 0.8,
    } | settings
    return FovealObservationModel((draw(4, 3, 4) / 2).exp(), EDGES, CLASSES, **parameters)


@pytest.fixture
def looks(random_looks):
    return random_looks(GRID, looks=3, most=4, components=4, dtype=torch.float64)


def watch(observer, looks, fixations=FIXATIONS):
    belief = observer.start(1, GRID, looks.scores)
    said = observer.weigh(looks, fixations.to(looks.boxes), GRID)
    for number in range(len(fixations)):
        belief = observer.update(belief, said[number : number + 1])
    return belief


def test_the_likelihood_sums_over_what_each_detection_may_show():
    """A miss, or one detection shows the object and the others are clutter: the joint density, divided by clutter's."""
    generator = torch.Generator().manual_seed(0)
    density = torch.rand(3, 4, generator=generator, dtype=torch.float64) + 0.1  # of three detections, by class
    weight = torch.rand(3, generator=generator, dtype=torch.float64)
    miss = torch.rand(4, generator=generator, dtype=torch.float64)
    clutter = density[:, 0].prod()
    expected = [1.0]
    for k in (1, 2, 3):
        joint = miss[k] * clutter
        for shown in range(3):
            others = [density[other, 0] for other in range(3) if other != shown]
            joint = joint + weight[shown] * density[shown, k] * others[0] * others[1]
        expected.append(float(joint / clutter))
    got = one_of(density[None] / density[None, :, :1], weight[None, :, None], miss[None, None])
    assert got.flatten().tolist() == pytest.approx(expected)


def test_the_belief_equals_a_loop_over_cells(looks):
    fom = model().requires_grad_(False)
    belief = watch(SemanticSearch(fom), looks)
    cells, prior = GRID.cell_of(FIXATIONS).tolist(), 1e-5
    offset = torch.cdist(GRID.centres.double(), FIXATIONS.double()) / 100
    for x in range(20):
        closest = int(offset[x].argmin())
        # A tie keeps the earlier look, as argmin does.
        level = int(fom.level(offset[x, closest]))
        missed = [1.0] + [float(fom.log_miss[k, level].exp()) for k in (1, 2, 3)]
        likelihoods = {"given the looks": [*missed], "while the search goes on": [*missed]}
        for row in looks.mask[closest].nonzero()[:, 0].tolist():
            box, scores = looks.boxes[closest, row], looks.scores[closest, row]
            if not bool(GRID.footprint(box[None], "box_centre")[0, x]):
                continue
            calibrated = fom.calibrate(scores, GRID.box_distance(box[None], FIXATIONS[closest].double())[0])
            covers = GRID.footprint(box[None])[0]
            share = 0.2 if any(bool(covers[cell]) for cell in cells[: closest + 1]) else 1.0
            for k in (1, 2, 3):
                ratio = float(calibrated[k] / calibrated[0])
                likelihoods["given the looks"][k] += ratio
                likelihoods["while the search goes on"][k] += share * ratio
        got = {
            "given the looks": belief.probabilities[0, x],
            "while the search goes on": torch.stack([belief.chance(k)[0, x] for k in range(4)]),
        }
        for condition, likelihood in likelihoods.items():
            posterior = torch.tensor(likelihood) / sum(likelihood)
            # With the mean of Kaplan's rule: the prior, and one observation of the posterior.
            expected = (prior + posterior) / (1 + 4 * prior)
            torch.testing.assert_close(got[condition].float(), expected, rtol=1e-5, atol=1e-7)
    assert belief.visited[0].nonzero()[:, 0].tolist() == sorted(cells)


def test_refutation_takes_what_covers_a_fixated_cell(looks):
    """With ρ = 1 a look at a covered cell is like one that shows nothing; with ρ = 0 fixations do not matter."""
    full = Detections(torch.tensor([[[0.0, 0.0, 100.0, 80.0]]]).double(), looks.scores[:1, :1], torch.ones(1, 1).bool())
    nothing = replace(full, mask=torch.zeros(1, 1).bool())
    sure = SemanticSearch(model(refutation=1.0).requires_grad_(False))
    seen, unseen = (watch(sure, look, FIXATIONS[:1]) for look in (full, nothing))
    torch.testing.assert_close(seen.chance(2), unseen.chance(2))
    # That the search goes on says nothing of what the look shows.
    assert float(seen.probability(2).max()) > float(unseen.probability(2).max())
    weight, covered = torch.rand(2, 3, 20), torch.rand(2, 3, 20)
    everywhere = torch.ones(2, 20, dtype=torch.bool)
    assert torch.equal(refuted(weight, covered, everywhere, torch.tensor(0.0)), weight)
    assert torch.equal(refuted(weight, covered, ~everywhere, torch.tensor(1.0)), weight)


def test_gradients_flow_through_three_looks(looks):
    fom = model()
    # All boxes cover the cell that is fixated first.
    boxes = looks.boxes * torch.tensor([0.0, 0, 1, 1])
    looks = Detections(boxes, looks.scores, torch.ones_like(looks.mask))
    observer = SemanticSearch(fom)
    # The numbers of cells are for maps.
    parameters = {name: value for name, value in fom.named_parameters() if name != "log_cell"}
    names = [*parameters]
    assert set(names) == {"log_alpha", "log_prior", "log_exponents", "log_miss", "refutation"}

    def belief(*values):
        class Held(torch.nn.Module):
            def __init__(self):
                super().__init__()
                self.observer = observer

            def forward(self):
                return watch(observer, looks).chance(2)

        named = {f"observer.model.{name}": value for name, value in zip(names, values, strict=True)}
        return torch.func.functional_call(Held(), named, ())

    values = [parameter.detach().clone().requires_grad_() for parameter in parameters.values()]
    assert torch.autograd.gradcheck(belief, values)
    assert all(float(each.abs().sum()) > 0 for each in torch.autograd.grad(belief(*values).log().sum(), values))


def test_looks_are_joined_and_fade(looks):
    fom = model(torch.float32).requires_grad_(False)
    observer = SemanticSearch(fom)
    seen = Detections(looks.boxes.float(), looks.scores.float(), looks.mask)
    said = observer.weigh(seen, FIXATIONS, GRID)
    few = observer.weigh(Detections(seen.boxes[:1, :2], seen.scores[:1, :2], seen.mask[:1, :2]), FIXATIONS[:1], GRID)
    together = SearchEvidence.join([few, said[1:]])
    belief = observer.update(observer.start(3, GRID, seen.scores), together)
    for row, part in enumerate((few, said[1:2], said[2:])):
        alone = observer.update(observer.start(1, GRID, seen.scores), part)
        torch.testing.assert_close(belief.beta[row], alone.beta[0])
        torch.testing.assert_close(belief.following[row], alone.following[0])
    none = torch.zeros_like(belief.visited)
    faded = observer.fade(belief, together, 0.5, none)
    assert not faded.visited.any()
    for name in ("beta", "following"):
        values = getattr(belief, name)
        torch.testing.assert_close(getattr(faded, name), 1e-5 + 0.5 * (values - 1e-5))


def test_a_search_needs_odds_of_a_miss(looks):
    bare = FovealObservationModel.identity(CLASSES, EDGES)
    refused("miss_rate: expected a model fitted with miss rates", watch, SemanticSearch(bare), looks)


def test_the_most_probable_cell_and_the_highest_score_tell_whether_the_picture_holds_the_target(looks):
    thresholds = Thresholds(0.7, 0.1)
    presence = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((3,), 0.5), thresholds)
    plain, told = (SemanticSearch(model(presence=each).requires_grad_(False)) for each in (None, presence))
    assert (plain.thresholds, told.thresholds) == (None, thresholds)
    without, belief = (watch(observer, looks) for observer in (plain, told))
    assert torch.equal(belief.probability(2), without.probability(2))
    for target in (1, 2, 3):
        peak = float(belief.probability(target).max())
        assert float(without.presence(target)) == pytest.approx(peak)
        seen = [(scores[:, target] * mask).max() for scores, mask in zip(looks.scores, looks.mask, strict=True)]
        odds = -0.4 + 0.7 * math.log(peak / (1 - peak)) + 0.2 * math.log(1 + float(max(seen)) / 3e-4)
        assert float(belief.presence(target)) == pytest.approx(1 / (1 + math.exp(-odds)), rel=1e-5)


def test_candidates_that_are_too_faint_for_a_detection_tell_of_the_picture_and_of_no_cell(looks):
    presence = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((3,), 0.5))
    observer = SemanticSearch(model(presence=presence).requires_grad_(False))
    hinted = looks.highest.clone()
    hinted[1, 2] = 0.97
    plain, told = (watch(observer, replace(looks, highest=each)) for each in (looks.highest, hinted))
    assert torch.equal(plain.probability(2), told.probability(2))
    odds = plain.presence(2).logit() + 0.2 * (
        math.log1p(0.97 / 3e-4) - math.log1p(float(looks.highest[:, 2].max()) / 3e-4)
    )
    torch.testing.assert_close(told.presence(2).logit(), odds)


@pytest.mark.parametrize("footprint", ["box_centre", "overlap"])
def test_two_numbers_of_the_footprint_make_the_probabilities_of_cells_true(looks, footprint):
    """In all cells, given the looks alone and for the next fixation; presence reads what they were before."""
    numbers = {"overlap": torch.tensor([-0.5, 0.6]), "box_centre": torch.tensor([1.5, 0.8])}
    common = torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((3,), 0.5)
    told = Presence(*common, place=numbers["overlap"], centre=numbers["box_centre"])
    observers = [
        SemanticSearch(model(presence=each).requires_grad_(False), footprint=footprint)
        for each in (Presence(*common, place=torch.tensor([0.0, 1.0])), told)
    ]
    plain, true = (watch(observer, looks) for observer in observers)
    offset, slope = numbers[footprint].tolist()
    for name in ("probability", "chance"):
        before, after = (getattr(belief, name)(2)[0].double().tolist() for belief in (plain, true))
        expected = [1 / (1 + math.exp(-offset - slope * math.log(each / (1 - each)))) for each in before]
        assert after == pytest.approx(expected, rel=1e-4)
    assert torch.equal(plain.presence(2), true.presence(2))
    before, after = (observer.unseen(looks.boxes)[1:].double() for observer in observers)
    torch.testing.assert_close(after.logit(), offset + slope * before.logit(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("footprint", ["centre", "soft"])
def test_no_fit_knows_the_probabilities_of_cells_of_other_footprints(looks, footprint):
    common = torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((3,), 0.5)
    told = Presence(*common, place=torch.tensor([-0.5, 0.6]), centre=torch.tensor([1.5, 0.8]))
    observers = [
        SemanticSearch(model(presence=each).requires_grad_(False), footprint=footprint)
        for each in (Presence(*common), told)
    ]
    plain, same = (watch(observer, looks) for observer in observers)
    for name in ("probability", "chance"):
        assert torch.equal(getattr(plain, name)(2), getattr(same, name)(2))
    assert torch.equal(*(observer.unseen(looks.boxes) for observer in observers))


def draw_search(generator, dtype=torch.float32):
    """Looks from all cells of a 5 × 4 grid at a cup; far from the fovea, cups are seen where there are none."""
    cup, cat = torch.randperm(20, generator=generator)[:2].tolist()
    centres, boxes, scores, mask = GRID.centres, [], [], []
    for fixation in range(20):
        rows = []
        for cell in range(20):
            distance = float((centres[cell] - centres[fixation]).norm() / 100)
            chance = torch.rand(3, generator=generator).tolist()
            if cell in (cup, cat):
                sharp = 0.9 - 0.5 * distance
                of = 1 if cell == cup else 2
                if chance[0] > 0.2 + 0.5 * distance:
                    rows.append((cell, of, sharp))
            elif chance[1] < 0.3 * distance:
                rows.append((cell, 1, 0.3 + 0.65 * chance[2]))
        frame = torch.zeros(8, 4), torch.full((8, 4), 0.25), torch.zeros(8, dtype=torch.bool)
        for number, (cell, of, score) in enumerate(rows[:8]):
            frame[0][number] = torch.cat([centres[cell] - 5, centres[cell] + 6])
            frame[1][number] = torch.full((4,), (1 - score) / 3).index_fill(0, torch.tensor(of), score)
            frame[2][number] = True
        for kept, each in zip((boxes, scores, mask), frame, strict=True):
            kept.append(each)
    answers = torch.zeros(20, 4, dtype=torch.bool)
    answers[cup, 1] = True
    seen = Detections(torch.stack(boxes).to(dtype), torch.stack(scores).to(dtype), torch.stack(mask))
    return AnnotatedLooks(0, seen, centres, GRID, answers, torch.tensor([1]))


def landing(observer, searches, looks=3):
    """Mean loss over searches with three looks, from fixed orders."""
    generator = torch.Generator().manual_seed(5)
    orders = [torch.randperm(20, generator=generator)[:looks] for _ in searches]
    losses = [landing_loss(observer, each, order) for each, order in zip(searches, orders, strict=True)]
    return torch.stack([loss for loss in losses if loss is not None]).mean()


def test_training_through_three_looks_makes_searches_better():
    """α, misses and exponents learn from the belief after each of three looks; other scenes judge."""
    generator = torch.Generator().manual_seed(11)
    searches = [draw_search(generator) for _ in range(20)]
    train, others = searches[:10], searches[10:]
    start = FovealObservationModel.identity(CLASSES, EDGES, miss_odds=torch.full((4, 3), 0.3))
    observer = SemanticSearch(start)
    before = float(landing(observer, others).detach())
    chosen = [start.log_alpha, start.log_miss, start.log_exponents]
    optimiser = torch.optim.Adam(chosen, lr=0.1)
    kept = [each.detach().clone() for each in chosen]
    for _ in range(10):
        optimiser.zero_grad()
        landing(observer, train).backward()
        optimiser.step()
    after = float(landing(observer, others).detach())
    assert all(not torch.equal(new, old) for new, old in zip(chosen, kept, strict=True))
    assert after < before - 0.1


@pytest.mark.parametrize("frozen", [False, True])
def test_the_fit_through_the_belief_changes_the_odds_of_a_miss_by_a_parabola(frozen):
    generator = torch.Generator().manual_seed(14)
    searches = [draw_search(generator) for _ in range(4)]
    start = FovealObservationModel.identity(CLASSES, [0.1, 0.2, 0.3, 0.4, 0.5]).requires_grad_(not frozen)
    fitted = fit_through_belief(start, searches, looks=3, steps=4, batch=2)
    assert torch.equal(fitted.log_alpha, start.log_alpha)
    assert torch.equal(fitted.log_prior, start.log_prior)
    assert torch.equal(fitted.log_exponents.exp(), torch.full((6,), 0.75).log().exp())
    assert float(fitted.refutation.detach()) == pytest.approx(0.9)
    curves = fitted.log_miss.detach().double()[1:]
    assert float((curves - math.log(1e-4)).abs().max()) > 0.01
    # Third differences of a parabola are 0.
    torch.testing.assert_close(curves.diff(n=3), torch.zeros(len(curves), 3).double(), rtol=0, atol=1e-5)
    assert not fitted.log_miss[0].any()
    assert type(fitted) is FovealObservationModel
    assert all(parameter.requires_grad for parameter in fitted.parameters())
    assert {name for name, _ in fitted.named_parameters()} == {name for name, _ in start.named_parameters()} | {
        "log_miss"
    }


def test_the_fit_through_the_belief_lands_sooner_and_keeps_the_model_it_starts_from():
    generator = torch.Generator().manual_seed(12)
    searches = [draw_search(generator) for _ in range(40)]
    start = FovealObservationModel.identity(CLASSES, EDGES)
    state = {name: value.clone() for name, value in start.state_dict().items()}
    fitted = fit_through_belief(start, searches[:20], looks=4, steps=20, batch=4)
    untrained = fit_through_belief(start, searches[:20], looks=4, steps=1, batch=1, rate=1e-9)
    losses = [float(landing(SemanticSearch(each), searches[20:]).detach()) for each in (untrained, fitted)]
    torch.testing.assert_close(untrained.miss_odds(torch.zeros(1)).detach(), torch.tensor([[1.0, *[1e-4] * 3]]))
    assert losses[1] < losses[0] - 0.1
    assert all(torch.equal(value, state[name]) for name, value in start.state_dict().items())
    # Few photographs show a rare class, so classes share what is learned.
    odds = fitted.log_miss.detach()
    torch.testing.assert_close(odds[1:], odds[1:2].expand(3, 3))
    assert fitted.metadata["method"] == "search"


@pytest.fixture
def told():
    """A model with presence, of which three looks make each class almost sure."""
    presence = Presence(torch.tensor(60.0), torch.tensor([0.7, 0.2]), torch.tensor([0.2, 0.5, 0.8]))
    return model(presence=presence.double(), refutation=0.5)


def test_before_the_first_look_and_where_all_has_faded_presence_is_even(told, looks):
    observer = SemanticSearch(told)
    start = observer.start(1, GRID, looks.boxes)
    assert start.presence(1).tolist() == [0.5]
    seen = watch(observer, looks)
    assert float(seen.presence(1).detach()) > 0.99
    gone = observer.fade(seen, None, 1e-30, seen.visited)
    assert float(gone.presence(1).detach()) == pytest.approx(0.5)


def test_gradients_are_finite_where_presence_is_sure_and_a_prior_is_set(told, looks):
    belief = watch(SemanticSearch(told, prior=Prior(0.2, 0.5)), looks)
    (belief.presence(1).sum() + belief.probability(1).sum()).backward()
    gradients = [parameter.grad for parameter in told.presence.parameters() if parameter.grad is not None]
    assert len(gradients) >= 2
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)


@pytest.mark.parametrize("count", [2, 3])
def test_any_of_several_classes_is_there_in_half_of_the_pictures(told, count):
    strategy = Strategy(AnyOf(SemanticSearch(told), dict.fromkeys(range(1, count + 1), 1.0)), Policy("non-predictive"))
    changed, prior = strategy.with_prior(None, 1)
    start = changed.observer.start(1, GRID, torch.zeros(1, dtype=torch.float64))
    assert float(start.presence(1).detach()) == pytest.approx(0.5)
    assert prior.assumed is None
    refused("prior: expected None for a search for any of several classes", strategy.with_prior, 0.3, 1)


def test_presence_is_checked(told):
    shares, weight, offset = torch.full((3,), 0.5), torch.ones(2), torch.tensor(0.0)
    for wrong in (torch.tensor([0.5, 1.0, 0.5]), torch.tensor([0.0, 0.5, 0.5])):
        refused("shares: expected numbers above 0 and below 1", Presence, offset, weight, wrong)
    refused("offset: expected a floating-point tensor", Presence, torch.tensor(1), weight, shares)
    refused("slopes: expected shape", Presence, offset, torch.ones(3), shares)
    refused("centre: expected shape", partial(Presence, centre=torch.ones(3)), offset, weight, shares)
    refused("thresholds: expected Thresholds or None", Presence, offset, weight, shares, (0.5, 0.1))
    refused(
        "presence: expected one of 3 classes, got one of 2",
        lambda: model(presence=Presence(offset, weight, shares[:2])),
    )
    refused("presence: expected a Presence or None", lambda: model(presence=3))
    refused("model: expected a FovealObservationModel", SemanticSearch, "yolox-nano-search")
    refused("prior: expected a Prior", lambda: SemanticSearch(told, prior=0.2))
