"""`python -m train.fit_search`: small on the embedded scenes, and its parts against loops."""

import json

import pytest
import torch

from semfov.belief import TargetEvidence
from semfov.training.evidence import objective, series
from semfov.training.evidence_examples import Examples
from train.fit_search import main

CELLS = 12


@pytest.fixture
def examples():
    torch.manual_seed(0)
    goal = torch.rand(30, CELLS) < 0.2
    goal[:, 0] = True
    goal[:, 5] = False
    return Examples(
        features=torch.rand(30, 4, CELLS, 10),
        distance=torch.rand(30, 4, CELLS),
        fixated=torch.randint(0, CELLS, (30, 4)),
        goal=goal,
        scene=torch.arange(30),
    )


def test_series_use_only_looks_off_target(examples):
    torch.manual_seed(1)
    model = TargetEvidence(4, 4)
    log_odds, goal, visited = series(model, examples, 4, torch.Generator().manual_seed(0))
    assert log_odds.shape == goal.shape == visited.shape
    assert len(goal) == int((~examples.goal.gather(1, examples.fixated)).any(1).sum())
    assert not (goal & visited).any()
    assert visited.any(1).all()
    assert set(visited.sum(1).tolist()) >= {1, 2, 3}


def test_a_series_of_one_look_is_that_look(examples):
    torch.manual_seed(1)
    model = TargetEvidence(4, 4)
    first = slice(0, 1)
    single = Examples(
        examples.features[:, first],
        examples.distance[:, first],
        examples.fixated[:, first],
        examples.goal,
        examples.scene,
    )
    kept = ~single.goal.gather(1, single.fixated)[:, 0]
    log_odds, _, visited = series(model, single, 4, torch.Generator().manual_seed(0))
    evidence = model.evidence(single.features[kept, 0])
    fixated = torch.nn.functional.one_hot(single.fixated[kept, 0], CELLS).bool()
    assert torch.equal(visited, fixated)
    expected = model.log_odds(evidence, evidence, single.distance[kept, 0], fixated, 4)
    torch.testing.assert_close(log_odds, expected)


def test_objective_equals_its_formula():
    torch.manual_seed(0)
    log_odds, goal = torch.randn(3, CELLS, dtype=torch.float64), torch.zeros(3, CELLS, dtype=torch.bool)
    goal[:, [2, 7]] = True
    visited = torch.zeros(3, CELLS, dtype=torch.bool)
    visited[:, 4] = True
    hit, entropy = [], []
    for row in range(3):
        free = [cell for cell in range(CELLS) if cell != 4]
        weights = log_odds[row, free].exp()
        hit.append(torch.log(log_odds[row, [2, 7]].exp().sum() / weights.sum()))
        chance = log_odds[row, free].sigmoid()
        truth = goal[row, free]
        entropy.append(-torch.where(truth, chance.log(), (1 - chance).log()))
    expected = torch.cat(entropy).mean() - torch.stack(hit).mean()
    torch.testing.assert_close(objective(log_odds, goal, visited), expected)


SMALL = [
    "--data.limit", "6", "--fixations", "3", "--holdout", "3", "--min_objects", "1", "--shard", "2", "--steps", "40",
    "--batch", "8", "--workers",
]  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A model trained on three looks at each of 6 embedded scenes."""
    out = tmp_path_factory.mktemp("fit_search")
    threads = torch.get_num_threads()
    assert main([*SMALL, "1", "--out", str(out)]) == 0
    torch.set_num_threads(threads)
    return out


@pytest.mark.weights
@pytest.mark.slow
def test_training_leaves_a_model_that_hits_more_often(trained):
    model = TargetEvidence.from_pretrained(trained / "yolov3-tiny.safetensors")
    assert model.metadata["detector"]["name"] == "yolov3-tiny"
    assert model.metadata["training"]["steps"] == 40
    judged = json.loads((trained / "judged.json").read_text())
    assert judged[-1]["cross_entropy"] < judged[0]["cross_entropy"] / 2
    assert "next fixation hits" in (trained / "report.md").read_text()


@pytest.mark.weights
@pytest.mark.slow
def test_two_workers_give_the_same_bits(trained, tmp_path):
    threads = torch.get_num_threads()
    torch.manual_seed(1)  # what the caller draws elsewhere changes nothing
    assert main([*SMALL, "2", "--out", str(tmp_path)]) == 0
    torch.set_num_threads(threads)
    for name in ("yolov3-tiny.safetensors", "judged.json", "report.md"):
        assert (tmp_path / name).read_bytes() == (trained / name).read_bytes(), name
