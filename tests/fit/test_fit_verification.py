"""The fit of the verification, against loops and SciPy."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from semfov import ActivePerception, DataError, EmbeddedScenes, Eye, FovealObservationModel, Foveation
from semfov.belief import Verification
from semfov.belief.observers import Semantic, SemanticSearch
from semfov.fit.searches import SearchEnd, TargetSearch, open_photographs, photograph_searches
from semfov.fit.settings import VerificationConfig
from semfov.fit.verification import (
    _LEVELS,
    _STRENGTH,
    CloserLookSamples,
    VerifiedSearch,
    choose_confirm,
    examine,
    fit_to_closer_looks,
    verify,
)
from semfov.fit.verification_part import _SHIPPED
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.runs.looking import Looking
from semfov.runs.store import cell_store, look_everywhere
from tests.refusals import unusable
from tests.small import CLASSES, Blobs


def examined(count=200, seed=0):
    """Closer looks whose outcome depends on two of the features."""
    generator = torch.Generator().manual_seed(seed)
    features = 2 * torch.randn(count, 7, generator=generator)
    noise = torch.randn(2, count, generator=generator)
    right, present = features[:, 3] + noise[0] > 0.5, features[:, 0] + noise[1] > -1
    return CloserLookSamples(features, right, present, torch.arange(count) % 4, torch.randn(count, generator=generator))


@pytest.mark.parametrize("count", [200, 60])
def test_the_fit_minimises_the_penalised_cross_entropy(count):
    """With a prior, the penalty is the distance to it."""
    known = examined(count)
    chosen, prior = known.fold != 1, shipped() if count == 60 else None
    model = fit_to_closer_looks(known, chosen, prior)
    phi = known.features[chosen].double().numpy()
    mean, scale = phi.mean(0), phi.std(0, ddof=1)
    of_class = known.known[chosen].double().numpy()
    for row, goal in enumerate((known.right, known.present)):
        there, centre, strength = goal[chosen].numpy(), np.zeros(8), np.array([1e-4] * 7 + [0])
        if prior is not None:
            given = prior.linear.weight[row].double().numpy()
            centre = np.append(given * scale, float(prior.linear.bias[row]) + given @ mean)
            strength = np.full(8, _STRENGTH / len(phi))

        def loss(parameters, there=there, centre=centre, strength=strength):
            odds = (phi - mean) / scale @ parameters[:7] + parameters[7] + of_class
            distance = (strength * (parameters - centre) ** 2).sum()
            return np.logaddexp(0, np.where(there, -odds, odds)).mean() + distance

        best = minimize(loss, np.zeros(8), tol=1e-12).x
        weight = best[:7] / scale
        np.testing.assert_allclose(model.linear.weight[row].numpy(), weight, atol=2e-3)
        assert float(model.linear.bias[row]) == pytest.approx(best[7] - weight @ mean, abs=2e-3)


def test_the_fit_ignores_the_closer_looks_that_are_held_out():
    known = examined()
    other = known.features.clone()
    other[known.fold == 2] = 100.0
    changed = known._replace(features=other)
    assert torch.equal(
        fit_to_closer_looks(known, known.fold != 2).linear.weight,
        fit_to_closer_looks(changed, known.fold != 2).linear.weight,
    )


def test_with_more_closer_looks_the_fit_moves_from_the_prior_to_the_fit_without():
    prior, distances = shipped(), []
    for count in (8, 80, 800, 8000):
        known = examined(count)
        near, far = fit_to_closer_looks(known, known.fold >= 0, prior), fit_to_closer_looks(known, known.fold >= 0)
        logits = [each(known.features) for each in (prior, near, far)]
        distances.append(float((logits[1] - logits[0]).abs().mean() / (logits[2] - logits[0]).abs().mean()))
    assert distances == sorted(distances)
    assert distances[0] < 0.3
    assert distances[-1] > 0.85
    known = examined(4)
    with pytest.raises(DataError, match=r"expected closer looks in all folds but one, got 1; give more photographs"):
        fit_to_closer_looks(known, known.fold == 0, shipped())


def shipped():
    """The centre of the prior, without the thresholds and the detector of the file."""
    model = Verification()
    model.linear.load_state_dict(Verification.from_pretrained(_SHIPPED).linear.state_dict())
    return model.eval().requires_grad_(False)


def examined_in(seen, searching, config):
    """Closer looks at the most evident places of photographs."""
    return examine(photograph_searches(seen, searching, config.looks, "looking"), config.folds)


def verified_in(seen, models, searching, config):
    """The searches of photographs with all their closer looks."""
    limits = Thresholds(1.0, config.stop_below, config.place)
    searches = photograph_searches(seen, searching, config.looks, "verifying")
    return verify(searches, models, limits)


def searched(present, places, ends, presence, looks):
    """A search of a photograph without the search that makes no closer looks."""
    return VerifiedSearch(0, present, False, places, ends, presence, looks, SearchEnd(None, looks))


PLACES = st.lists(st.tuples(st.floats(0, 1), st.booleans()), max_size=3)


@given(PLACES, st.sampled_from(_LEVELS))
def test_the_decision_at_a_threshold_equals_a_walk_through_the_closer_looks(places, confirm):
    ends = tuple(range(2, 2 + len(places)))
    verified = searched(True, tuple(places), ends, 0.5, 9)
    expected = None, 9
    best, is_right = 0.0, None
    for number, ((place, right), end) in enumerate(zip(places, ends, strict=True), 1):
        if place > best:
            best, is_right = place, right
        is_sure = place >= confirm + (1 - confirm) / 2
        # After two closer looks a place is found that is probable enough.
        if is_sure or (number >= 2 and best >= confirm):
            expected = is_right, end
            break
        if best >= confirm:
            expected = is_right, 9
    assert verified.found(confirm) == expected


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12), st.floats(0, 1))
def test_the_threshold_is_the_least_with_few_enough_false_alarms(places, share):
    searches = [searched(False, ((place, False),), (2,), place, 3) for place in places]
    searches.append(searched(True, ((1.0, True),), (2,), 1.0, 2))
    chosen = choose_confirm(searches, share)
    assert choose_confirm(searches, share, 0.6) == min(chosen, 0.6)

    def alarms(confirm):
        return sum(place >= confirm for place in places) / len(places)

    fits = [level for level in _LEVELS if alarms(level) <= share + 1e-12]
    assert chosen == (fits[0] if fits else _LEVELS[-1])


SOUGHT = VerificationConfig(columns=4, rows=3, max_target_area=1.0)


class Opened(Looking):
    """Embedded scenes that are looked at in 4 × 3 cells."""

    def __init__(self, eye, scenes, store):
        self.config, self.cells, self.eye, self.scenes = SOUGHT, (4, 3), eye, scenes
        self.store = None if store is None else cell_store(store, eye.settings(), 4, 3, len(CLASSES) + 1)


def opened(detector, store=None):
    """Three embedded scenes with classes to search for, and a model that searches them."""
    eye = Eye(Foveation(9.0), detector, reference=64.0).requires_grad_(False)
    scenes = EmbeddedScenes(CLASSES, count=3)
    presence = Presence(
        torch.tensor(0.5), torch.tensor([1.0, 0.0]), torch.tensor([0.3, 0.5, 0.8]), Thresholds(0.7, 0.01)
    )
    odds = torch.full((4, 3), 0.1)
    searching = FovealObservationModel.identity(
        CLASSES, [0.2, 0.5], miss_odds=odds, refutation=0.9, presence=presence
    ).requires_grad_(False)
    run = Opened(eye, scenes, store)
    return open_photographs(run, [0, 1, 2], SOUGHT), searching, run


@pytest.fixture
def seen():
    return opened(Blobs())


def test_looks_from_a_store_equal_those_of_the_eye(tmp_path):
    live, searching, run = opened(Limited())
    eye, scenes = run.eye, run.scenes
    stored = Opened(eye, scenes, tmp_path)
    for each in live:
        image, digest = partial(lambda index: scenes[index].image[None], each.index), partial(scenes.digest, each.index)
        look_everywhere(eye, image, each.grid, stored.store, digest)
    seen = steps_of(live, searching)
    eye.detector.most = eye.detector.passes  # no further look
    for one, other in zip(seen, steps_of(open_photographs(stored, [0, 1, 2], SOUGHT), searching), strict=True):
        torch.testing.assert_close(one.belief.probability(1), other.belief.probability(1))


def steps_of(photographs, searching):
    """All looks of all searches of photographs."""
    searches = (TargetSearch(each, sought, searching, 5) for each in photographs for sought in each.targets)
    return [step for search in searches for step in search.steps]


def test_further_absent_classes_serve_only_to_choose_thresholds(seen):
    _, searching, run = seen
    sought = SimpleNamespace(**{**vars(SOUGHT), "classes": 1, "absent": 0})
    few, many = (open_photographs(run, [0, 1, 2], sought, spare=n) for n in (0, 1))
    config = VerificationConfig(columns=4, rows=3, looks=3, folds=2)
    for one, other in zip(few, many, strict=True):
        assert [each.target for each in other.targets if not each.spare] == [each.target for each in one.targets]
        assert all(not each.present for each in other.targets if each.spare)
    assert any(each.spare for photograph in many for each in photograph.targets)
    first, second = examined_in(few, searching, config), examined_in(many, searching, config)
    assert torch.equal(first.features, second.features)
    searches = list(verified_in(many, 2 * [shipped()], searching, config))
    assert [each.spare for each in searches] == [each.spare for photograph in many for each in photograph.targets]


@pytest.mark.parametrize("confirm", [0.5, 0.7])
def test_searches_end_as_those_of_an_agent(seen, confirm):
    """The agent looks by itself and with other code, with closer looks and without."""
    found, searching, run = seen
    searching.presence.thresholds = Thresholds(0.55, 0.3, 0.3)
    model = shipped()
    config = VerificationConfig(columns=4, rows=3, looks=6, folds=2, stop_below=0.1, place=0.1)
    model.thresholds = Thresholds(confirm, config.stop_below, config.place)
    search, explore = (SemanticSearch(searching), Policy("non-predictive")), (Semantic(4), Policy("random"))
    agent = ActivePerception(run.eye, search, explore, verification=model, grid=(4, 3)).eval()
    searches = iter(verified_in(found, [model, model], searching, config))
    ends = []
    for photograph in found:
        image = run.scenes[photograph.index].image
        for sought in photograph.targets:
            verified, options = next(searches), {"start": int(sought.start), "shifts": config.looks - 1, "prior": "fit"}
            scanpath = agent.search(image, sought.target, how="fovea", **options)
            right, looks = verified.found(confirm)
            assert scanpath.found == (right is not None)
            assert len(scanpath.cells) + len(scanpath.closer) == looks
            if scanpath.found:
                assert bool(sought.goal[scanpath.decision.cell]) == right
                made = [place for (place, _), end in zip(verified.places, verified.ends, strict=True) if end <= looks]
                assert scanpath.decision.place == pytest.approx(max(made), abs=1e-5)
            plain = agent.search(image, sought.target, how="fovea", **options, closer=0)
            right = bool(sought.goal[plain.decision.cell]) if plain.found else None
            assert (right, len(plain.cells)) == verified.unverified
            ends.append((scanpath.found, len(scanpath.closer), plain.found))
    assert any(closer for _, closer, _ in ends)


def test_classes_are_present_and_absent_as_the_goal_says(seen):
    photographs, _, run = seen
    for photograph in photographs:
        annotation = run.scenes.annotation(photograph.index)
        for sought in photograph.targets:
            assert sought.present == (sought.target in annotation.labels.tolist())
            for cell in range(len(photograph.grid)):
                alone = torch.zeros(len(photograph.grid)).bool()
                alone[cell] = True
                boxes = annotation.boxes[annotation.labels == sought.target]
                covered = len(boxes) > 0 and bool(photograph.grid.footprint(boxes)[:, cell].any())
                assert bool(sought.goal[cell]) == covered


def test_closer_looks_are_labelled_by_the_annotated_boxes(seen):
    found, searching, _ = seen
    config = VerificationConfig(columns=4, rows=3, looks=3, folds=2)
    known = examined_in(found, searching, config)
    assert known.features.shape == (len(known.right), 7)
    assert set(known.fold.tolist()) == {0, 1}
    # By class, how often it is searched for where it is.
    sought = [each.target for photograph in found for each in photograph.targets]
    of_classes = torch.tensor([0.3, 0.5, 0.8]).logit()[torch.tensor(sought) - 1]
    assert {round(each, 4) for each in known.known.tolist()} <= {round(each, 4) for each in of_classes.tolist()}
    # A place can only be right in a photograph that holds the target.
    assert bool((known.present | ~known.right).all())
    models = [fit_to_closer_looks(known, known.fold != fold) for fold in (0, 1)]
    searches = list(verified_in(found, models, searching, config))
    assert len(searches) == sum(len(photograph.targets) for photograph in found)
    for each in searches:
        assert len(each.places) == len(each.ends) <= 2
        assert list(each.ends) == sorted(each.ends)
        assert each.looks >= max(each.ends, default=1)
    unusable("got only one kind", examine, [])


class Limited(Blobs):
    """A detector that counts its passes and stops after some."""

    def __init__(self, most=10**9):
        super().__init__()
        self.most, self.passes = most, 0

    def propose(self, canvas):
        if self.passes == self.most:
            raise KeyboardInterrupt
        self.passes += 1
        return super().propose(canvas)


def all_of(detector, store):
    """Examine and verify the embedded scenes."""
    config = VerificationConfig(columns=4, rows=3, looks=3, folds=2)
    found, searching, _ = opened(detector, store)
    known = examined_in(found, searching, config)
    return known, list(
        verified_in(found, [fit_to_closer_looks(known, known.fold != fold) for fold in (0, 1)], searching, config)
    )


def test_interrupted_searches_continue_with_the_stored_looks(tmp_path):
    """Only the photograph that was interrupted is looked at again, and the results are those of one run."""
    whole = Limited()
    known, searches = all_of(whole, None)
    most, total = whole.passes // 2, 0
    with pytest.raises(KeyboardInterrupt):
        all_of(Limited(most), tmp_path)
    finished = len(list(tmp_path.rglob("*.safetensors")))
    assert 0 < finished < 3
    resumed = Limited()
    again, verified = all_of(resumed, tmp_path)
    total = resumed.passes + most
    assert whole.passes < total < 2 * whole.passes
    assert resumed.passes < whole.passes
    for one, other in zip(known, again, strict=True):
        assert torch.equal(one, other)
    assert searches == verified
    idle = Limited(0)
    assert all_of(idle, tmp_path)[1] == searches
    assert idle.passes == 0
