"""Searches that decide whether a target is present: records against step-by-step searches, overlaps and landings."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchvision.ops import box_iou

from eval.decide.run import DecideConfig, DecisionRun, landing, overlap, quarters, sharp_place
from semfov import DataError, Detections, DirichletBelief, FovealObservationModel, Grid, InputError
from semfov.belief.observers import Semantic, SemanticSearch
from semfov.decision import OUTCOMES, decide, decision_without_closer_looks
from semfov.detection import score_vectors
from semfov.detection.detector import FAINT
from semfov.episode import StoredLooks, rollout
from semfov.gaze.acquisition import TargetPosterior, Uniform
from semfov.gaze.choice import Greedy, drawn_from
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.runs.config import BeliefConfig, DataConfig, ProtocolConfig
from semfov.runs.protocols import choose_classes
from semfov.runs.seeds import generator_for, noise_for

pytestmark = pytest.mark.usefixtures("few_samples")

AT = Thresholds(0.5, 0.375)
FUSED = ["calibrated belief", "calibrated belief, a detection at the gaze"]


def write_model(path, thresholds):
    """Save the shipped model of searches with other thresholds, at which some searches find or give up."""
    model = FovealObservationModel.from_pretrained("yolox-nano-search")
    model.presence = Presence(torch.tensor(0.5), torch.tensor([0.5, 0.0]), torch.full((80,), 0.5), thresholds)
    model.save(path)
    return str(path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("decisions")


@pytest.fixture(scope="module")
def config(folder):
    return DecideConfig(
        data=DataConfig(limit=3, max_target_area=0.5),
        belief=BeliefConfig(columns=4, rows=3, search_model=write_model(folder / "model.safetensors", AT)),
        protocol=ProtocolConfig(shifts=6),
        cache=folder / "cache",
        out=folder / "out",
        workers=1,
    )


@pytest.fixture(scope="module")
def run(config):
    return DecisionRun(config)


def scores_of_candidates(detector, image, target):
    """Scores of the target in all boxes of the detector's head that are not too faint."""
    candidates = detector.propose(detector.fit(image)[0])
    vectors = score_vectors(candidates, detector.background)[0]
    rows = zip(vectors[:, target].tolist(), candidates.confidence[0].tolist(), strict=True)
    return [score for score, confidence in rows if confidence >= FAINT]


def scores_in_quarters(run, index, target):
    """Scores of the target in the four quarters of a scene."""
    image = run.scenes[index].image
    height, width = image.shape[-2] // 2, image.shape[-1] // 2
    scores = []
    for top, left in ((0, 0), (0, width), (height, 0), (height, width)):
        bottom, right = (height if top == 0 else None), (width if left == 0 else None)
        scores += scores_of_candidates(run.eye.detector, image[None, :, top:bottom, left:right], target)
    return scores


def test_quarters_cover_every_pixel_once():
    image = torch.arange(35.0).reshape(1, 1, 5, 7)
    parts = quarters(image)
    assert [tuple(part.shape[-2:]) for part in parts] == [(2, 3), (2, 4), (3, 3), (3, 4)]
    assert sorted(value for part in parts for value in part.flatten().tolist()) == list(range(35))


@pytest.mark.slow
def test_a_run_compares_gaze_and_beliefs_at_the_given_thresholds(config):
    run = DecisionRun(replace(config, confirm=0.6))
    assert list(run.compared) == ["non-predictive-learned", "random gaze", *FUSED]
    assert run.thresholds == Thresholds(0.6, AT.stop_below)


def detects_at_the_gaze(step, grid, target, least=0.5):
    """1 if a detection over the fixated cell gives the target the detector's own score `least` at least, else 0."""
    detections = step.detections
    for box, own, there in zip(detections.boxes[0], detections.class_scores[0], detections.mask[0], strict=True):
        over = bool(grid.footprint(box[None])[0, int(step.cell)])
        if bool(there) and over and float(own[target - 1]) >= least:
            return 1
    return 0


@pytest.mark.slow
def test_records_match_searches_run_step_by_step(run):
    outcomes = set()
    for index in range(3):
        records, seconds = run.outcomes(index)
        assert set(seconds) == {"look", "search"}
        annotation, grid, scene = run.scenes.annotation(index), run.grid(index), run.scenes.ids[index]
        targets = choose_classes(run.scenes, index, annotation, 1, 0.5, 0)
        assert [(r["target"], r["policy"]) for r in records] == [
            (target, policy) for target in targets for policy in ("non-predictive-learned", "random gaze", *FUSED)
        ]
        assert [r["present"] for r in records] == [True] * 4 + [False] * 4
        detections = run.detections(index)
        for record in records:
            target = record["target"]
            assert record["scene"] == scene
            assert record["present"] == (target in annotation.labels.tolist())
            largest = scores_of_candidates(run.eye.detector, run.scenes[index].image[None], target)
            assert record["sharp"] == pytest.approx(max(largest, default=0.0))
            assert record["tiled"] == pytest.approx(
                max([*largest, *scores_in_quarters(run, index, target)], default=0.0)
            )
            start = torch.randint(12, (1,), generator=generator_for("start", 0, scene, target))
            noise = noise_for(run.config.protocol, 12, scene, target, 0)[None]
            acquisition = Uniform() if record["policy"] == "random gaze" else TargetPosterior(target)
            observer, at_the_gaze = SemanticSearch(run.models.search), record["policy"] == FUSED[1]
            if record["policy"] in FUSED:
                model = run.models.observation
                observer, acquisition = Semantic(81, model), Policy("predictive", model)(target, grid)
            looks = StoredLooks(detections, grid, torch.tensor([target]))
            steps, ended = [], 0
            with torch.inference_mode():
                choice = Greedy(drawn_from(noise))
                for step in rollout(looks, observer, acquisition, start, choice, most=7):
                    steps.append(step)
                    ended = detects_at_the_gaze(step, grid, target) if at_the_gaze else int(decide(step, target, AT))
                    if ended:
                        break
            belief, seen = steps[-1].belief, [int(step.cell) for step in steps]
            assert record["looks"] == len(steps)
            assert record["outcome"] == OUTCOMES[ended]
            assert record["probability"] == pytest.approx(float(belief.presence(target)), abs=1e-6)
            outcomes.add(record["outcome"])
            goal = grid.footprint(annotation.boxes)[annotation.labels == target].any(0)
            if record["outcome"] == "found":
                parts = [detections[cell : cell + 1] for cell in seen]
                decision = decision_without_closer_looks(
                    ended, belief, parts, grid, target, seen[-1] if at_the_gaze else None
                )
                assert record["right_place"] == bool(goal[decision.cell])
                assert record["overlap"] == overlap(decision.box, annotation.boxes[annotation.labels == target])
            else:
                assert record["right_place"] is record["overlap"] is None
            hit = next((number for number, cell in enumerate(seen) if goal[cell]), 0)
            if hit == 0:
                assert record["landing"] is None
            else:
                before, after = (float(steps[n].belief.probability(target)[0, seen[hit]]) for n in (hit - 1, hit))
                assert record["landing"] == pytest.approx([before, after], abs=1e-6)
                assert record["landing_seen"] == bool(detects_at_the_gaze(steps[hit], grid, target, 0.0))
    assert {"found", "absent"} <= outcomes


def test_a_model_without_thresholds_still_decides(config, folder):
    path = write_model(folder / "none.safetensors", None)
    run = DecisionRun(replace(config, belief=replace(config.belief, search_model=path)))
    records, _ = run.outcomes(0)
    assert len(records) == 8


def test_the_published_belief_is_left_out_without_an_observation_model(config, monkeypatch):
    monkeypatch.setattr(FovealObservationModel, "shipped", config.out / "none")
    assert list(DecisionRun(config).compared) == ["non-predictive-learned", "random gaze"]
    named = replace(config, belief=replace(config.belief, model="nowhere.safetensors"))
    with pytest.raises((InputError, DataError), match="nowhere"):
        DecisionRun(named)


def test_a_sharp_look_is_scored_by_its_most_confident_box():
    """The valid box with the highest score counts; its centre is in the third cell of the second row."""
    grid = Grid(4, 3, (80, 60))
    boxes = torch.tensor([[[42.0, 22, 58, 38], [0, 0, 20, 20], [60, 40, 80, 60]]])
    scores = torch.tensor([[[0.4, 0.6], [0.5, 0.5], [0.1, 0.9]]])
    seen = Detections(boxes, scores, torch.tensor([[True, True, False]]))
    goal = torch.zeros(12, dtype=torch.bool)
    goal[6] = True
    place = sharp_place(seen, grid, 1, goal, torch.tensor([[42.0, 22, 58, 54]]))
    assert place == {"right": True, "overlap": pytest.approx(0.5)}
    assert sharp_place(seen, grid, 1, ~goal, boxes[0, :0]) == {"right": False, "overlap": None}
    assert sharp_place(Detections.empty(1, 1), grid, 1, goal, boxes[0]) is None


corner = st.floats(0, 50)
boxes = st.tuples(corner, corner, st.floats(1, 40), st.floats(1, 40)).map(
    lambda b: (b[0], b[1], b[0] + b[2], b[1] + b[3])
)


@given(boxes, st.lists(boxes, max_size=4))
def test_overlap_is_the_largest_of_torchvision(box, others):
    given, there = torch.tensor(box).double(), torch.tensor(others).double().reshape(-1, 4)
    expected = pytest.approx(float(box_iou(given[None], there).max()), abs=1e-9) if others else None
    assert overlap(given, there) == expected
    assert overlap(None, there) is None


@pytest.mark.parametrize(
    ("path", "expected"),
    [((2, 3, 1), [0.1, 0.2]), ((1, 3, 2), None), ((0, 2), None), ((0, 1, 3), [0.1, 0.2]), ((0, 2, 3), [0.2, 0.3])],
)
def test_landing_holds_probabilities_before_and_after_the_first_look_at_the_target(path, expected):
    """Probabilities of cell `c` after look `n` are (n + 1) / 10; the target is in cells 1 and 3."""
    goal = torch.tensor([False, True, False, True])
    beliefs = []
    for number in range(len(path)):
        beta = torch.tensor([9.0 - number, 1.0 + number]).expand(1, 4, 2)
        beliefs.append(DirichletBelief(beta))
    got = landing(beliefs, torch.tensor(path), goal, 1)
    assert got == (None if expected is None else pytest.approx(expected))
