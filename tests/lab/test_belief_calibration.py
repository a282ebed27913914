"""Calibration of beliefs along searches: sums against loops over cells, beliefs step by step, missing models."""

import math
import shutil
from dataclasses import replace

import pytest
import torch

from eval.calibration.beliefs import BANDS, CELL_GROUPS, COUNTS, BeliefCalibrationRun
from eval.calibration.beliefs_report import _add_up, _curves, _landing_table, _pooled, write_belief_report
from eval.calibration.sums import AddedSums
from eval.search.run import SearchConfig
from semfov import FovealObservationModel, InputError, rollout
from semfov.belief.observers import Semantic, SemanticMap, SemanticSearch
from semfov.episode import StoredLooks
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_from
from semfov.runs.config import BeliefConfig, DataConfig, ProtocolConfig
from semfov.runs.protocols import choose_classes
from semfov.runs.scene_run import finish
from semfov.runs.seeds import generator_for, noise_for

pytestmark = pytest.mark.usefixtures("few_samples")

BELIEFS = ["raw", "calibrated", "tempered", "learned", "semantic map"]


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("beliefs")
    return SearchConfig(
        data=DataConfig(limit=2, max_target_area=0.5),
        belief=BeliefConfig(columns=4, rows=3),
        protocol=ProtocolConfig(shifts=COUNTS[-1] - 1),
        cache=folder / "cache",
        out=folder / "out",
        workers=1,
    )


@pytest.fixture(scope="module")
def run(config):
    return BeliefCalibrationRun(config)


def probabilities_along(run, target, path, detections, grid):
    """Probabilities of the target `(looks, X·Y)` after every look of a path, by belief."""
    model = FovealObservationModel.from_pretrained("yolox-nano")
    observers = {
        "raw": Semantic(81),
        "calibrated": Semantic(81, model),
        "tempered": Semantic(81, tempering=0.5),
        "learned": SemanticSearch(run.models.search),
        "semantic map": SemanticMap(run.models.map),
    }
    probabilities = {}
    for name, observer in observers.items():
        belief, probabilities[name] = observer.start(1, grid, detections.scores), []
        for cell in path:
            belief = observer(belief, detections[cell : cell + 1], grid.centres[cell : cell + 1], grid, target)
            probabilities[name].append(belief.probability(target)[0])
    return probabilities


@pytest.mark.slow
def test_sums_match_beliefs_updated_step_by_step(run):
    assert list(run.observers) == BELIEFS
    assert run.left_out == {}
    for index in range(2):
        records, seconds = run.outcomes(index)
        assert set(seconds) == {"look", "believe"}
        annotation, grid, scene = run.scenes.annotation(index), run.grid(index), run.scenes.ids[index]
        assert [r["target"] for r in records] == choose_classes(run.scenes, index, annotation, 1, 0.5, 0)
        assert [r["present"] for r in records] == [True, False]
        detections = run.detections(index)
        for record in records:
            target = record["target"]
            goal = grid.footprint(annotation.boxes)[annotation.labels == target].any(0)
            start = torch.randint(12, (1,), generator=generator_for("start", 0, scene, target))
            noise = noise_for(run.config.protocol, 12, scene, target, 0)[None]
            looks = StoredLooks(detections, grid, torch.tensor([target]))
            with torch.inference_mode():
                choice = Greedy(drawn_from(noise))
                steps = rollout(
                    looks, SemanticSearch(run.models.search), TargetPosterior(target), start, choice, most=15
                )
                path = [int(step.cell) for step in steps]
                probabilities = probabilities_along(run, target, path, detections, grid)
            # The search ends after 12 looks, when every cell has been fixated.
            assert sorted(path) == list(range(12))
            for name in BELIEFS:
                judged = record["beliefs"][name]
                assert list(judged["looks"]) == ["1", "5"]
                for looked in (1, 5):
                    seen, p = path[:looked], probabilities[name][looked - 1]
                    groups = {cell: [] for cell in CELL_GROUPS}
                    for cell in range(12):
                        closest = min(math.dist(grid.centres[cell], grid.centres[f]) for f in seen) / max(grid.size)
                        band = sum(closest > edge for edge in BANDS)
                        groups[CELL_GROUPS[0 if cell in seen else 1 + band]].append((float(p[cell]), bool(goal[cell])))
                    got = judged["looks"][str(looked)]
                    assert set(got) == {name for name, cells in groups.items() if cells}
                    for group, cells in groups.items():
                        if cells:
                            sums = AddedSums.from_record(got[group])
                            assert sums.count == len(cells)
                            assert sums.nll * len(cells) == pytest.approx(
                                sum(-math.log(q if y else 1 - q) for q, y in cells), rel=1e-4
                            )
                            assert sums.brier * len(cells) == pytest.approx(
                                sum((q - y) ** 2 for q, y in cells), rel=1e-4
                            )
                            assert sums.bins[2].sum() == sum(y for _, y in cells)
                hit = next((number for number, cell in enumerate(path) if goal[cell]), 0)
                if hit == 0:
                    assert judged["landing"] is record["seen"] is None
                else:
                    pair = [float(probabilities[name][number][path[hit]]) for number in (hit - 1, hit)]
                    assert judged["landing"] == pytest.approx(pair, abs=1e-5)
                    look = detections[path[hit] : path[hit] + 1]
                    over = grid.footprint(look.boxes)[0, :, path[hit]] & look.mask[0]
                    best = [int(scores.argmax()) for scores, there in zip(look.scores[0], over, strict=True) if there]
                    assert record["seen"] == (target in best)


@pytest.mark.slow
def test_a_belief_is_left_out_when_its_model_is_not_shipped(config, run, tmp_path, monkeypatch):
    for name in ("yolox-nano", "yolox-nano-sharp"):
        shutil.copy(FovealObservationModel.shipped / f"{name}.safetensors", tmp_path)
    monkeypatch.setattr(FovealObservationModel, "shipped", tmp_path)
    bare = BeliefCalibrationRun(replace(config, belief=BeliefConfig(columns=4, rows=3), out=tmp_path))
    assert list(bare.observers) == [*BELIEFS[:3], "semantic map"]
    assert bare.guide == "tempered"
    assert bare.key != run.key
    finish(bare, "believing")
    text, written = write_belief_report(bare)
    assert all(path.stat().st_size > 200 for path in written)
    assert "Left out because no fitted model is shipped: learned (detector: no observation model is" in text
    assert "The tempered belief guides the gaze" in text
    with pytest.raises(InputError, match="unknown observation model 'mine'"):
        BeliefCalibrationRun(replace(config, belief=replace(config.belief, map_model="mine")))


def cells(*pairs):
    """A record of cells, given as pairs of a probability and whether the cell holds the target."""
    return AddedSums.of(torch.tensor([p for p, _ in pairs]), torch.tensor([y for _, y in pairs])).record()


def test_searches_add_up_by_belief_looks_and_group():
    searches = [
        {
            "seen": True,
            "beliefs": {
                "a": {
                    "looks": {"1": {"fixated": cells((0.9, True)), CELL_GROUPS[1]: cells((0.2, False))}},
                    "landing": [0, 1],
                }
            },
        },
        {
            "seen": False,
            "beliefs": {"a": {"looks": {"1": {"fixated": cells((0.5, False), (0.7, True))}}, "landing": [0.5, 0.25]}},
        },
        {"seen": None, "beliefs": {"a": {"looks": {"1": {CELL_GROUPS[2]: cells((0.1, False))}}, "landing": None}}},
    ]
    sums = _add_up(searches)
    assert {key: each.count for key, each in sums.items()} == {
        ("a", 1, "fixated"): 3,
        ("a", 1, CELL_GROUPS[1]): 1,
        ("a", 1, CELL_GROUPS[2]): 1,
    }
    every = _pooled(sums, "a", 1)
    assert (every.count, every.rate) == (5, 0.4)
    assert every.brier == pytest.approx((0.01 + 0.04 + 0.25 + 0.09 + 0.01) / 5)
    panels, errors = _curves(sums)
    assert torch.equal(panels["after 1 look"]["a"], every.bins)
    assert errors == {"a": {group: sums["a", 1, group].ece for group in CELL_GROUPS[:3]}}
    means = ["3", "0.250 → 0.625"]
    assert _landing_table(searches) == [["a", "2", means[1], "1", "0.000 → 1.000", "1", "0.500 → 0.250"]]
