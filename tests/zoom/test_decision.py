"""Whether a large picture holds a class, probabilities of its objects, and numbers of those not shown."""

import json
import math
from dataclasses import replace
from itertools import islice, product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import nbinom
from torch.nn import functional as F

from semfov import Detections, EmbeddedScenes, Objects, WindowEye, ZoomAgent
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation
from semfov.decision import OUTCOMES, settle
from semfov.detection.objects import unlike
from semfov.fit.logistic import logistic_regression
from semfov.fit.windows_certainty import _fit_unseen, _Numbers, explorations_of_kinds, fit_spread
from semfov.fit.windows_decisions import WindowSearches, fit_presence, judge_searches
from semfov.io.storage import read
from semfov.metrics.calibration import calibration_error
from semfov.observation.matching import right_boxes
from semfov.observation.thresholds import Thresholds
from semfov.paths import ZoomPath
from semfov.runs.zoom_store import StoredWindowLooks
from semfov.settings import ExploreSettings, FindSettings, SearchSettings
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.certainty import DISPERSION, FACTS, SPREAD, Certainty, number_of
from semfov.zoom.episode import find_everything, look_for
from semfov.zoom.evidence import PhotographEvidence
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook
from semfov.zoom.object_facts import DetectedBoxes, object_facts
from semfov.zoom.objects import merge, merge_with_facts, probable_objects, without_parts
from semfov.zoom.places import SearchFacts
from tests.refusals import refused
from tests.small import Tiles, area, iou, shared

SHARE = st.floats(0, 1, width=32)


@given(SHARE, st.booleans(), SHARE, SHARE, SHARE)
def test_decisions_follow_the_rule(presence, looked, left, confirm, stop_below):
    ended = settle(*(torch.tensor([each]) for each in (presence, looked, left)), Thresholds(confirm, stop_below))
    if presence >= confirm and looked:
        expected = 1
    elif left >= stop_below:
        expected = 0
    else:
        expected = 2 if presence < 0.5 else 3
    assert int(ended) == expected


@pytest.fixture
def eye(detector):
    return WindowEye(detector)


def steps(eye, picture, target, most=6):
    torch.manual_seed(0)
    source = LiveWindowLooks(eye, eye.open(picture))
    steps = look_for(source, GlimpseEvidence(3).eval(), target)
    with torch.inference_mode():
        return [step for step, _ in zip(steps, range(most), strict=False)]


def drawn_certainty(seed):
    """A certainty of objects with weights drawn at random."""
    offset, *weights = torch.randn(1 + len(FACTS), generator=torch.Generator().manual_seed(seed)).mul(0.3).tolist()
    return Certainty(offset, tuple(weights), scale=0.5, strength=4.0, faint=0.25)


@pytest.mark.parametrize("certainty", [None, drawn_certainty(1)])
def test_a_search_expects_the_objects_that_an_exploration_lists_and_those_that_looks_would_find(
    eye, picture, certainty
):
    target, seen = 3, steps(eye, picture, 3)
    belief = seen[0].belief
    belief.evidence.certainty = certainty
    facts = SearchFacts(belief)
    for step in seen:
        facts.add(step.look)
    looks = [step.look for step in seen]
    listed, _ = probable_objects(looks, belief.lattice, target, certainty or Certainty.of([0.0, 1.0]))
    unseen = 0.0
    if certainty is not None:
        levels = torch.stack([belief.expected(level).detach() for level in range(1, belief.lattice.levels)])
        of_cells = levels.amax(0)
        is_clear = of_cells >= 0.1
        unseen = 0.5 * float((of_cells * torch.where(is_clear, 1.0, 0.25)).sum())
        assert unseen > 0
    assert len(listed)
    assert facts.expected() == pytest.approx(float(listed.scores.sum()) + unseen, rel=1e-5)
    boxes = torch.cat([look.detections.boxes[0] for look in looks])
    confidence = torch.cat([look.detections.scores[0, :, target] for look in looks])
    assert facts.box.tolist() == boxes[confidence.argmax()].tolist()


def test_before_fitting_the_probability_is_the_best_score(eye, picture):
    seen = steps(eye, picture, 1)
    facts = SearchFacts(seen[0].belief)
    for step in seen:
        facts.add(step.look)
        assert facts.presence() == pytest.approx(min(max(facts.best, 1e-4), 1 - 1e-4), abs=1e-5)


@given(st.floats(1e-3, 0.999), st.floats(0, 100), st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3))
def test_odds_of_presence_are_powers_of_those_of_the_score_and_of_the_number(score, number, a, b, c):
    model = GlimpseEvidence(3).double()
    with torch.no_grad():
        model.whole.weight.copy_(torch.tensor([[a, b]]))
        model.whole.bias.fill_(c)
    odds = math.exp(c) * (score / (1 - score)) ** a * (number + 0.001) ** b
    values = torch.tensor([score, number], dtype=torch.float64)
    assert float(model.presence(*values).detach()) == pytest.approx(math.log(odds), abs=1e-5)


def test_decisions_use_the_thresholds_of_the_evidence(eye, picture, tmp_path):
    torch.manual_seed(0)
    evidence = GlimpseEvidence(3, thresholds=Thresholds(0.3, 0.02))
    evidence.save(tmp_path / "own.safetensors")
    evidence = GlimpseEvidence.from_pretrained(tmp_path / "own.safetensors")
    assert evidence.thresholds == Thresholds(0.3, 0.02)
    agent = ZoomAgent(eye, evidence)
    path = agent.search(picture, "red")
    assert path.decision.outcome == "found"
    assert path.decision.probability >= 0.3
    longer = agent.search(picture, "red", SearchSettings(confirm=1.0, stop_below=0.0, passes=path.passes + 2))
    assert longer.passes > path.passes
    assert longer.decision.outcome == "undecided"
    assert agent.search(picture, "green", SearchSettings(stop_below=1.0)).passes == 1


def synthetic(count, seed):
    """Random searches; the probability that the target is present follows from the best score and the number."""
    generator = torch.Generator().manual_seed(seed)
    best = torch.rand(count, 1, generator=generator)
    expected = torch.randn(count, 1, generator=generator).exp()
    odds = 0.5 * torch.logit(best, eps=1e-4) + 2 * (expected + 0.01).log() - 1
    there = torch.rand(count, generator=generator) < odds[:, 0].sigmoid()
    return WindowSearches(best, expected, best > 0.1, torch.zeros(count, 1), there), odds[:, 0]


@pytest.mark.parametrize("target", [1, 2, 3])
@pytest.mark.parametrize(("confirm", "stop_below"), [(0.9, 0.005), (0.3, 0.2), (1.0, 0.0), (0.0, 1.0)])
def test_searches_end_as_if_every_look_were_judged(eye, picture, target, confirm, stop_below):
    """A search computes the probability only where it can matter; here it is computed after every look."""
    most, thresholds = 6, Thresholds(confirm, stop_below)
    torch.manual_seed(0)
    evidence, source = GlimpseEvidence(3).eval(), LiveWindowLooks(eye, eye.open(picture))
    facts, passes, ended = None, 0, 0
    with torch.inference_mode():
        for step in look_for(source, evidence, target):
            facts = facts or SearchFacts(step.belief)
            facts.add(step.look)
            presence, passes = facts.presence(), passes + 1
            state = torch.tensor([presence]), torch.tensor([facts.detected]), torch.tensor([step.next_value])
            ended = int(settle(*state, thresholds))
            if ended or passes == most:
                break
        path = ZoomAgent(eye, evidence).search(
            picture, target, SearchSettings(passes=most, confirm=confirm, stop_below=stop_below)
        )
    assert path.passes == passes
    assert path.decision.outcome == OUTCOMES[ended]
    assert path.decision.probability == presence


def test_a_fitted_probability_is_calibrated():
    torch.manual_seed(0)
    model = GlimpseEvidence(3)
    known, _ = synthetic(4000, 1)
    fit_presence(model, known)
    new, odds = synthetic(4000, 2)
    with torch.no_grad():
        log_odds = model.presence(new.best, new.expected)[:, 0]
    best = F.binary_cross_entropy_with_logits(odds, new.there.float())
    loss = F.binary_cross_entropy_with_logits(log_odds, new.there.float())
    raw = F.binary_cross_entropy(new.best[:, 0], new.there.float())
    assert loss < best + 0.1 * (raw - best)
    assert calibration_error(log_odds.sigmoid(), new.there) < 0.03 < calibration_error(new.best[:, 0], new.there)

    class Bounds:
        false_alarms, surest, lost = 0.05, 1.0, 0.02

    rows = judge_searches(model, new, Bounds())
    assert "ECE" in rows[0]
    sure = (log_odds.sigmoid() >= model.thresholds.confirm) & new.detected[:, 0]
    assert sure[~new.there].double().mean() <= 0.05


@pytest.mark.parametrize("there", [True, False])
def test_searches_of_one_kind_leave_the_highest_score_as_the_probability(there):
    """Where every picture holds each class, they would make it sure of what no look shows."""
    model = GlimpseEvidence(3)
    known, _ = synthetic(50, 1)
    fit_presence(model, known._replace(there=torch.full((50,), there)))
    with torch.no_grad():
        log_odds = model.presence(torch.tensor([0.1, 0.9]), torch.tensor([0.0, 3.0]))
    assert log_odds.tolist() == pytest.approx([logit(0.1), logit(0.9)])


SCALES = torch.tensor([0.25, 0.5, 1.0, 0.5])
WINDOWS = torch.tensor([[0.0, 0, 400, 300], [0, 0, 200, 200], [50, 50, 150, 150], [100, 100, 300, 300]])
SIZE = (400, 300)


def logit(score):
    score = min(max(score, 0.01), 0.999)
    return math.log(score / (1 - score))


def visible(box, look):
    window, edge, scale = WINDOWS[look].tolist(), 2 / float(SCALES[look]), float(SCALES[look])
    low = [n + edge if n > 0 else -math.inf for n in window[:2]]
    high = [n - edge if n < side else math.inf for n, side in zip(window[2:], SIZE, strict=True)]
    inside = box[0] >= low[0] and box[1] >= low[1] and box[2] <= high[0] and box[3] <= high[1]
    return inside and math.sqrt(area(box)) * scale >= 6


def shown_in(number, look, boxes, scores, labels, looks, cut):
    """Best score with which a look shows an object, and the overlaps of other whole boxes with it."""
    box, best, overlaps = boxes[number], scores[number] if looks[number] == look else 0, []
    for other in range(len(boxes)):
        if looks[other] == look and labels[other] == labels[number] and other != number:
            whole = iou(box, boxes[other]) >= 0.5
            part = (
                cut[other] and looks[other] != looks[number] and shared(box, boxes[other]) >= 0.8 * area(boxes[other])
            )
            best = max(best, scores[other]) if whole or part else best
            overlaps += [iou(box, boxes[other])] if whole and not cut[other] else []
    return best, overlaps


def plain_facts(kept, boxes, scores, labels, looks, cut, latest):
    """The facts of object after object, look after look."""
    rows, bests = [], []
    for number in kept:
        box = boxes[number]
        seen = [look for look in range(len(SCALES)) if visible(box, look)]
        if latest:
            seen = [n for n in seen if not any(m > n and SCALES[m] >= SCALES[n] for m in seen)]
        told = [shown_in(number, look, boxes, scores, labels, looks, cut) for look in range(len(SCALES))]
        best = [score for score, _ in told]
        use = [look for look in range(len(SCALES)) if best[look] > 0 or look in seen]
        agreement = [each for _, overlaps in told for each in overlaps]
        finest = max(float(SCALES[look]) for look in use)
        sharpest = max(logit(best[look]) for look in use if SCALES[look] == finest)
        size = (math.log2(math.sqrt(area(box))) + math.log2(finest) - 5) / 2
        mean = sum(agreement) / len(agreement) - 0.6 if agreement else 0
        missed = sum(best[look] == 0 for look in seen)
        bests.append(logit(max(best)))
        numbers = math.log1p(sum(score > 0 for score in best)), math.log1p(missed)
        first = logit(scores[number]), bests[-1], sharpest, *numbers, float(cut[number])
        rows.append([*first, size, size**2, mean, 0, 0, 0, -math.log2(finest), 0])
    for (one, number), (other, rival) in product(enumerate(kept), repeat=2):
        if (bests[other], -other) <= (bests[one], -one):
            continue
        weight, box, better = 1 / (1 + math.exp(-bests[other])), boxes[number], boxes[rival]
        both, overlap = shared(box, better), iou(box, better)
        alike = (9, overlap), (10, both / area(box)), (11, both / area(better))
        for place, value in alike if labels[number] == labels[rival] else ((13, overlap),):
            rows[one][place] = max(rows[one][place], weight * value)
    return rows


@pytest.mark.parametrize("latest", [False, True])
def test_facts_equal_a_plain_loop(latest, dtype):
    generator = torch.Generator().manual_seed(3)
    count = 60
    corner = 40 + torch.rand(count, 2, generator=generator) * 90
    boxes = torch.cat([corner, corner + 8 + torch.rand(count, 2, generator=generator) * 50], -1).to(dtype)
    scores = (0.06 + 0.9 * torch.rand(count, generator=generator)).to(dtype)
    labels = torch.randint(1, 3, (count,), generator=generator)
    looks, cut = torch.randint(0, 4, (count,), generator=generator), torch.rand(count, generator=generator) < 0.3
    kept = unlike(boxes, scores, labels, looks, cut, SCALES[looks])
    assert 5 < len(kept) < count - 5
    every = boxes, scores, labels, looks, cut
    facts = object_facts(kept, DetectedBoxes(*every, SCALES[looks]), WINDOWS, SCALES, SIZE, 1.0, latest=latest)
    plain = plain_facts(kept.tolist(), *(each.tolist() for each in every), latest)
    assert facts.shape == (len(kept), len(FACTS))
    torch.testing.assert_close(facts, torch.tensor(plain), rtol=1e-4, atol=1e-4)
    assert (facts.std(0) > 0).all()  # every fact differs between these objects


def test_objects_have_the_facts_of_their_looks():
    lattice = Lattice.over((1280, 960), (160, 160))

    def look(level, box, score):
        vectors = torch.tensor([[[1 - score, score, 0.0]]])
        seen = Detections(torch.tensor([[box]]), vectors, torch.ones(1, 1, dtype=torch.bool))
        return WindowLook(Window.on(lattice, (level, 0, 0)), seen, torch.tensor([False]), torch.zeros(2), None)

    near, far = look(3, [20.0, 20, 90, 90], 0.9), look(1, [22.0, 20, 92, 91], 0.6)
    faint = look(2, [21.0, 20, 90, 92], 0.04)
    objects, facts = merge_with_facts([far, near, faint], lattice)
    sharp = merge([far, near, faint])
    assert objects.scores.tolist() == sharp.scores.tolist()
    weights = torch.tensor([0.9, 0.6 / 4**2])  # two octaves, of which each has a quarter of the pixels
    mean = weights / weights.sum() @ torch.tensor([[20.0, 20, 90, 90], [22.0, 20, 92, 91]])
    torch.testing.assert_close(objects.boxes, mean[None])
    assert merge_with_facts([far, near], lattice, latest=True)[0].boxes.tolist() == sharp.boxes.tolist()
    told = dict(zip(FACTS, facts[0].tolist(), strict=True))
    assert told["score"] == told["best"] == told["sharpest"] == pytest.approx(logit(0.9))
    assert told["shown"] == pytest.approx(math.log(3))
    assert told["missed"] == pytest.approx(math.log(2))  # a box of so low a score is none
    assert merge_with_facts([], lattice)[1].shape == (0, len(FACTS))


def random_look(window, count, seed):
    """A look with boxes of two classes that overlap in many ways."""
    generator = torch.Generator().manual_seed(seed)
    corner = 40 + torch.rand(count, 2, generator=generator) * 60
    boxes = torch.cat([corner, corner + 6 + torch.rand(count, 2, generator=generator) * 80], -1)
    scores = torch.rand(count, 3, generator=generator).softmax(-1)
    seen = Detections(boxes[None], scores[None], torch.ones(1, count, dtype=torch.bool))
    return WindowLook(window, seen, torch.zeros(count, dtype=torch.bool), torch.zeros(2), None)


def test_parts_of_surer_objects_are_left_out_unless_the_whole_picture_shows_them():
    """Against a loop over pairs; without what the whole picture shows only the sure ones are left."""
    lattice = Lattice.over((300, 200), (160, 160))
    whole = random_look(Window.overview(lattice), 12, 0)
    closer = [random_look(Window.around(lattice, (0.0, 0, 180, 200)), 40, seed) for seed in (1, 2)]
    for looks in ([whole, *closer], closer):
        merged = merge(looks)
        kept = without_parts(merged, looks)
        at_whole = merge([look for look in looks if look is whole])
        boxes, labels = merged.boxes.tolist(), merged.labels.tolist()
        shown = list(zip(at_whole.boxes.tolist(), at_whole.labels.tolist(), at_whole.scores.tolist(), strict=True))
        scores = merged.scores.tolist()
        left = []
        for worse in range(len(merged)):
            box, label = boxes[worse], labels[worse]
            rivals = [boxes[better] for better in left if labels[better] == label]
            is_part = any(shared(box, rival) >= 0.8 * min(area(box), area(rival)) for rival in rivals)
            enough = min(scores[worse], 0.3)
            is_shown = any(same == label and iou(box, seen) >= 0.5 and score >= enough for seen, same, score in shown)
            if is_shown or not is_part:
                left.append(worse)
        assert kept.boxes.tolist() == merged.boxes[left].tolist()
        assert 5 < len(left) < len(merged) - 5
    assert len(without_parts(merge([]), [])) == 0
    assert len(without_parts(merge([whole]), [whole])) == len(merge([whole]))


@pytest.mark.parametrize(("x", "count"), [(60.0, 1), (30.0, 2)])
def test_a_cut_box_is_the_same_object_from_half_of_its_area_on(x, count):
    """The finest window of 160 pixels cuts a box from x on, of which 60 pixels lie in one that another look shows."""
    lattice = Lattice.over((1280, 960), (160, 160))

    def look(level, box, cut):
        seen = Detections(torch.tensor([[box]]), torch.tensor([[[0.2, 0.8]]]), torch.ones(1, 1, dtype=torch.bool))
        return WindowLook(Window.on(lattice, (level, 0, 0)), seen, torch.tensor([cut]), torch.zeros(1), None)

    whole = look(1, [100.0, 20, 300, 90], False)
    objects, _ = merge_with_facts([whole, look(3, [x, 20.0, 160, 90], True)], lattice)
    assert len(objects) == count
    assert objects.boxes[objects.passes == 0].tolist() == [[100.0, 20, 300, 90]]  # the cut box does not count for it


def test_what_further_looks_show_is_fitted_by_the_number_in_all():
    """Pictures whose looks show half of what clear cells promise, and nothing else, teach this."""

    class Exploration:
        target, looks = None, 9

        def __init__(self, clear, faint):
            self.remaining = [(clear * (1 - n / 8), faint) for n in range(9)]
            self.promised = [clear * n / 8 for n in range(9)]
            self.after = [1 + clear / 2 * n / 8 for n in range(9)]

        def sum_after(self, certainty, number):
            return self.after[number - 1]

    fitted = _fit_unseen(
        Certainty.of([0.0, 1.0]), [Exploration(8.0, 20.0), Exploration(30.0, 5.0), Exploration(2.0, 40.0)]
    ).requires_grad_(False)
    for clear, faint in ((10.0, 30.0), (4.0, 5.0)):
        assert fitted.unseen((clear, faint), promised=0.0, discoveries=0.0)[0] == pytest.approx(clear / 2, rel=0.15)
        after = fitted.unseen((clear / 2, faint), promised=clear / 2, discoveries=clear / 4)[0]
        assert after == pytest.approx(clear / 4, rel=0.15)


def test_the_spread_covers_four_of_five_pictures():
    """Pictures whose number is off by a share that is uniform from 0 to 1/2 or 1: four fifths of the most."""
    for most, spread in ((0.5, 0.2), (1.0, 0.4)):
        mean = torch.full((200,), 20.0).double()
        shown = mean * (1 + most * torch.linspace(-1, 1, 200).double())
        kinds = {("mosaics", 8): _Numbers(mean, torch.zeros(200).double(), shown)}
        assert fit_spread(kinds)[0] == pytest.approx(spread)
        # A kind whose numbers are right needs less, and both count as much.
        kinds["scattered", 8] = _Numbers(mean, torch.ones(200).double(), mean)
        assert fit_spread(kinds)[0] == pytest.approx(0.15 if most == 0.5 else 0.3)
    few = _Numbers(*(each[:30] for each in kinds["scattered", 8]))
    assert fit_spread({("scattered", 8): few})[0] == pytest.approx(SPREAD)


def test_mixed_precision_does_not_round_whether_a_picture_holds_a_class():
    evidence = GlimpseEvidence.from_pretrained("yolox-nano").requires_grad_(False)
    best = torch.rand(50, generator=torch.Generator().manual_seed(0))
    target = torch.arange(1, 51)
    own = evidence.photograph
    exact = evidence.presence(best, 3 * best), own.presence(best, target), own.at_place(best)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(evidence.presence(best, 3 * best), exact[0])
        assert torch.equal(own.presence(best, target), exact[1])
        assert torch.equal(own.at_place(best), exact[2])


def test_mixed_precision_does_not_round_the_facts_of_a_certainty():
    generator = torch.Generator().manual_seed(0)
    facts = 5 * torch.randn(9, len(FACTS), generator=generator)
    certainty = Certainty(-1.0, torch.randn(len(FACTS), generator=generator).tolist())
    exact = certainty.probability(facts)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(certainty.probability(facts), exact)


def test_the_spread_is_fitted_on_the_numbers_of_records():
    eye = WindowEye(Tiles(name="bright"))
    mosaics = Mosaics(EmbeddedScenes(("person", "dog", "boat"), count=3), 4, 4, tile=(96, 72), count=1)
    certainty = Certainty(2.0, (1.0, *[0.0] * (len(FACTS) - 1)), scale=0.5, strength=2.0)
    torch.manual_seed(0)
    evidence = GlimpseEvidence(3, certainty=certainty).eval()
    source = StoredWindowLooks(eye, mosaics, 0, None)
    _, sought = explorations_of_kinds(evidence, {"mosaics": (mosaics, [source])}, 4)["mosaics"]
    looked = [step.look for step in islice(find_everything(source, evidence, sought.target), 8)]
    right = right_boxes(merge_with_facts(looked, source.lattice, sought.target)[0], mosaics.annotation(0))
    annotation = mosaics.annotation(0)
    assert sought.held == int((annotation.labels[~annotation.crowd] == sought.target).sum())
    assert torch.equal(sought.objects[sought.looks][1], right)
    for passes in (2, 4):
        record = ZoomAgent(eye, evidence).find_all(
            mosaics[0].image, sought.target, FindSettings(passes=passes, min_gain=0.0)
        )
        (expected,), (error,) = record.expected.values(), replace(record, spread=0.0).expected_error.values()
        assert sought.number(certainty, passes) == pytest.approx((expected, error**2), rel=1e-5)
    assert sought.number(Certainty(-9.0, certainty.weights.tolist(), scale=0.5, strength=2.0), 4) is None


def test_probabilities_of_the_fit_maximise_the_likelihood():
    generator = torch.Generator().manual_seed(0)
    facts = torch.randn(500, len(FACTS), generator=generator)
    right = torch.rand(500, generator=generator) < facts[:, 0].sigmoid()
    parameters = torch.tensor(logistic_regression(facts, right), dtype=torch.float64, requires_grad=True)
    inputs = torch.cat([torch.ones(500, 1), facts], -1).double()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(inputs @ parameters, right.double(), reduction="sum")
    empty = parameters[0].sigmoid()
    loss = loss + 0.5 * parameters[1:].square().sum() - 0.5 * (empty * (1 - empty)).log()
    (gradient,) = torch.autograd.grad(loss, parameters)
    assert gradient.abs().max() < 1e-3
    assert all(map(math.isfinite, logistic_regression(facts, torch.ones(500, dtype=torch.bool))))


def test_what_no_look_has_shown_is_negative_binomial():
    weights = (0.0,) * len(FACTS)
    certainty = Certainty(0.0, weights, scale=0.5, strength=4.0, faint=0.25, promise=0.4).requires_grad_(False)
    mean, variance = certainty.unseen((5.0, 4.0), promised=25.0, discoveries=3.0)
    shape, rate = 4 * 0.5 + 3, 4 + 10
    law = nbinom(shape, rate / (rate + 6))
    assert float(mean) == pytest.approx(law.mean())
    assert float(variance) == pytest.approx(law.var())
    assert certainty.unseen((0.0, 0.0), promised=10.0, discoveries=3.0) == (0.0, 0.0)
    # All cells and promises count in full.
    plain = Certainty(0.0, weights, scale=0.5, strength=4.0).requires_grad_(False)
    mean, variance = plain.unseen((2.0, 4.0), promised=10.0, discoveries=3.0)
    assert (float(mean), float(variance)) == pytest.approx((law.mean(), law.var()))


def test_a_scale_that_is_known_exactly_leaves_a_poisson_number():
    certainty = Certainty(0.0, (0.0,) * len(FACTS), scale=0.5)
    mean, variance = certainty.unseen((2.0, 4.0), promised=10.0, discoveries=3.0)
    assert mean.item() == variance.item() == 3.0
    gradients = torch.autograd.grad(mean + variance, [certainty.scale, certainty.strength])
    assert [gradient.item() for gradient in gradients] == [12.0, 0.0]


def test_a_file_keeps_the_numbers_of_a_certainty(tmp_path):
    numbers = [*drawn_certainty(0).numbers[:-1], 0.7]
    certainty = Certainty.of(numbers)
    assert certainty.numbers == numbers  # short decimals stay as they are
    assert certainty.spread == 0.7
    evidence = GlimpseEvidence(3, certainty=certainty, photograph=PhotographEvidence(3, certainty=drawn_certainty(1)))
    evidence.save(tmp_path / "a.safetensors")
    loaded = GlimpseEvidence.from_pretrained(tmp_path / "a.safetensors")
    assert loaded.certainty.numbers == numbers
    assert loaded.photograph.certainty.numbers == drawn_certainty(1).numbers
    loaded.save(tmp_path / "b.safetensors")
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()
    assert not any(name.startswith("certainty") for name in read(tmp_path / "a.safetensors", evidence.kind)[0])
    # A state has them too, the spread among them.
    other = Certainty.of([1.0] * 20)
    other.load_state_dict(certainty.state_dict())
    assert other.numbers == numbers
    refused("certainty: expected 2 or 20 numbers, got 3", Certainty.of, [1.0, 2.0, 3.0])
    refused("weights: expected 14 numbers, got 1", Certainty, 0.0, [1.0])


@pytest.mark.parametrize("name", ["yolox-nano", "yolov3-tiny", "nanodet-plus-m-1.5x"])
def test_shipped_numbers_are_those_of_the_file_in_float32(name):
    _, record = read(GlimpseEvidence.shipped / f"{name}.safetensors", GlimpseEvidence.kind)
    evidence = GlimpseEvidence.from_pretrained(name)
    for certainty, numbers in (
        (evidence.certainty, record["certainty"]),
        (evidence.photograph.certainty, record["photograph"]["certainty"]),
    ):
        assert np.array_equal(np.float32(certainty.numbers), np.float32(numbers))
        assert certainty.spread == numbers[-1]


def test_boxes_are_right_once_and_crowds_are_neither():
    boxes = torch.tensor(
        [[0.0, 0, 9, 9], [0, 0, 9, 8], [0, 0, 9, 9], [41, 41, 49, 49], [80, 80, 89, 89], [70, 0, 79, 9]]
    )
    labels = torch.tensor([1, 1, 2, 1, 1, 1])
    found = Objects(boxes, torch.linspace(0.9, 0.4, 6), labels, torch.zeros(6).long())
    there = torch.tensor([[0.0, 0, 9, 9], [40, 40, 60, 60], [80, 80, 89, 89], [70, 0, 79, 9]])
    annotation = Annotation(there, torch.tensor([1, 1, 2, 1]), torch.arange(4) == 1, (100, 100))
    assert right_boxes(found, annotation).tolist() == [1, 0, 0, -1, 0, 1]
    assert len(right_boxes(Objects.none(), annotation)) == 0


@pytest.fixture
def path(detector, picture):
    torch.manual_seed(0)
    weights = (1.0, *[0.0] * (len(FACTS) - 1))
    evidence = GlimpseEvidence(3, certainty=Certainty(3.0, weights, scale=0.5, strength=2.0))
    return ZoomAgent(WindowEye(detector), evidence).eval().find_all(picture, None, FindSettings(passes=4))


def test_the_number_varies_as_if_objects_came_in_pairs():
    """Each pair is there or not: its variance is brute-forced over all cases of three pairs."""
    chances = (0.2, 0.5, 0.9)
    mean = square = 0.0
    for pairs in product((0, 1), repeat=len(chances)):
        weight = math.prod(p if there else 1 - p for p, there in zip(chances, pairs, strict=True))
        mean += weight * 2 * sum(pairs)
        square += weight * (2 * sum(pairs)) ** 2
    number = number_of(torch.tensor(chances).repeat(2), (0.0, 0.0), 0.0)
    assert number == pytest.approx((mean, square - mean**2))


def test_a_record_counts_probable_objects_and_expects_more(path, tmp_path):
    assert path.score_threshold == 0.5
    assert (path.objects.scores >= 0.5).all()
    assert path.unseen[0] > 0
    assert path.spread == SPREAD
    chances = path.candidates.scores.double()
    assert sum(path.expected.values()) == pytest.approx(float(chances.sum()) + path.unseen[0], rel=1e-5)
    variance = DISPERSION * float((chances * (1 - chances)).sum()) + path.unseen[1]
    variance += sum((SPREAD * each) ** 2 for each in path.expected.values())
    assert sum(each**2 for each in path.expected_error.values()) == pytest.approx(variance, rel=1e-5)
    assert path.describe() == f"{len(path.objects)} objects found. 4 looks"
    path.save(tmp_path / "a.safetensors")
    loaded = ZoomPath.load(tmp_path / "a.safetensors")
    assert (loaded.expected, loaded.expected_error) == (path.expected, path.expected_error)
    assert len(replace(path, score_threshold=0.0).objects) == len(path.candidates)
    assert all(math.isnan(each) for each in replace(path, unseen=None).expected_error.values())


def test_evidence_of_earlier_versions_has_probabilities_by_the_score_alone():
    old = GlimpseEvidence(3)
    record = json.loads(json.dumps({**old._record(), "certainty": [-0.9, 1.1], "metadata": {}}))
    certainty = GlimpseEvidence._restore(record, dict(old.state_dict())).certainty
    facts = torch.randn(7, len(FACTS))
    torch.testing.assert_close(certainty.probability(facts), (-0.9 + 1.1 * facts[:, 0]).sigmoid())
    assert certainty.numbers == [-0.9, 1.1]


def test_the_least_probability_can_be_chosen(detector, picture):
    agent = ZoomAgent(WindowEye(detector), GlimpseEvidence(3)).eval()
    assert agent.find_all(picture, "red", FindSettings(passes=2)).score_threshold == 0.3  # scores, without a certainty
    assert agent.find_all(picture, "red", FindSettings(passes=2, score_threshold=0.7)).score_threshold == 0.7
    assert agent.explore(picture, ExploreSettings(passes=2, score_threshold=0.6)).score_threshold == 0.6
