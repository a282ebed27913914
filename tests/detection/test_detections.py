import torch

from semfov import Detections
from tests.refusals import refused


def detections(counts: list[int], classes: int = 3, seed: int = 0) -> Detections:
    generator = torch.Generator().manual_seed(seed)
    length = max(counts)
    mask = torch.arange(length) < torch.tensor(counts)[:, None]
    scores = torch.rand(len(counts), length, classes + 1, generator=generator).softmax(-1) * mask[..., None]
    boxes = torch.rand(len(counts), length, 4, generator=generator) * mask[..., None]
    return Detections(boxes, scores, mask)


def test_count_confidence_and_labels():
    scores = torch.tensor([[[0.5, 0.1, 0.4], [0.1, 0.6, 0.3], [0.0, 0.0, 0.0]]])
    d = Detections(torch.zeros(1, 3, 4), scores, torch.tensor([[True, True, False]]))
    assert d.count.tolist() == [2]
    torch.testing.assert_close(d.confidence, torch.tensor([[0.4, 0.6, 0.0]]))
    assert d.labels.tolist() == [[2, 1, 0]]


def test_stack_pads_to_the_longest():
    parts = [detections([2, 1]), detections([4], seed=1), Detections.empty(1, 3)]
    whole = Detections.stack(parts)
    assert whole.count.tolist() == [2, 1, 4, 0]
    assert whole.boxes.shape == (4, 4, 4)
    assert not whole.boxes[~whole.mask].any()
    torch.testing.assert_close(whole.boxes[2], parts[1].boxes[0])
    torch.testing.assert_close(whole.scores[0, :2], parts[0].scores[0])


def test_refuses_tensors_of_inconsistent_shapes():
    refused(".", Detections, torch.zeros(1, 2, 5), torch.zeros(1, 2, 3), torch.zeros(1, 2, dtype=torch.bool))
    refused(".", Detections, torch.zeros(1, 2, 4), torch.zeros(1, 3, 3), torch.zeros(1, 2, dtype=torch.bool))
    refused(".", Detections, torch.zeros(1, 2, 4), torch.zeros(1, 2, 3), torch.zeros(1, 2))


def test_batches_are_indexed_by_image_and_may_be_empty():
    d = detections([2, 1, 3])
    assert d[1:].count.tolist() == [1, 3]
    assert d[0].count.item() == 2
    assert d[torch.tensor([2, 0])].count.tolist() == [3, 2]
    d = Detections.empty(2, 80, like=torch.zeros(1, dtype=torch.float64))
    assert d.scores.shape == (2, 0, 81)
    assert d.boxes.dtype == torch.float64
    assert d.count.tolist() == [0, 0]
    assert d.labels.shape == (2, 0)
    refused("at least one", Detections.stack, [])
