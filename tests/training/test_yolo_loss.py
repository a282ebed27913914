"""YOLOv3's loss against the loops of Darknet's `yolo_layer.c`: its value, and the deltas that Darknet descends."""

import math

import pytest
import torch
from torch.func import functional_call

from semfov.detection.darknet_layers import Head
from semfov.errors import InputError
from semfov.training.yolo_loss import yolo_loss

CANVAS = (64, 32)
HEADS = [Head(((20.0, 12.0), (40.0, 28.0)), 3), Head(((6.0, 6.0), (20.0, 12.0)), 3, scale=1.1)]
SIZES = [(1, 2), (2, 4)]  # rows, columns


def sigmoid(x):
    return 1 / (1 + math.exp(-x))


def entropy(wanted, logit):
    p = sigmoid(logit)
    return -wanted * math.log(p) - (1 - wanted) * math.log(1 - p)


def overlap(a, b):
    """Intersection over union of two boxes (centre x, centre y, width, height)."""
    across = min(a[0] + a[2] / 2, b[0] + b[2] / 2) - max(a[0] - a[2] / 2, b[0] - b[2] / 2)
    down = min(a[1] + a[3] / 2, b[1] + b[3] / 2) - max(a[1] - a[3] / 2, b[1] - b[3] / 2)
    shared = max(across, 0) * max(down, 0)
    return shared / (a[2] * a[3] + b[2] * b[3] - shared)


def loss_by_loop(maps, boxes, labels, ignore):
    """The parts of the loss, and the gradient of their sum, by loops over numbers."""
    losses = {"objectness": 0.0, "classes": 0.0, "boxes": 0.0}
    deltas = [torch.zeros_like(raw) for raw in maps]
    for image, (own, names) in enumerate(zip(boxes, labels, strict=True)):
        objects = [
            ((x1 + x2) / 2, (y1 + y2) / 2, x2 - x1, y2 - y1, name)
            for (x1, y1, x2, y2), name in zip(own.tolist(), names.tolist(), strict=True)
        ]
        owners = {}
        for thing in objects:
            fits = {
                (h, a): overlap((0, 0, thing[2], thing[3]), (0, 0, *anchor))
                for h, head in enumerate(HEADS)
                for a, anchor in enumerate(head.anchors)
            }
            for (h, a), fit in fits.items():
                if fit == max(fits.values()):
                    rows, columns = SIZES[h]
                    row = min(int(thing[1] / CANVAS[1] * rows), rows - 1)
                    owners[h, a, row, min(int(thing[0] / CANVAS[0] * columns), columns - 1)] = thing
        for h, head in enumerate(HEADS):
            rows, columns = SIZES[h]
            for a, (pw, ph) in enumerate(head.anchors):
                for row in range(rows):
                    for column in range(columns):
                        t = maps[h][image, a * 8 : a * 8 + 8, row, column].tolist()
                        delta = deltas[h][image, a * 8 : a * 8 + 8, row, column]
                        move = (head.scale - 1) / 2
                        box = (
                            (sigmoid(t[0]) * head.scale - move + column) * CANVAS[0] / columns,
                            (sigmoid(t[1]) * head.scale - move + row) * CANVAS[1] / rows,
                            pw * math.exp(t[2]),
                            ph * math.exp(t[3]),
                        )
                        thing = owners.get((h, a, row, column))
                        if thing is None:
                            if max((overlap(box, other[:4]) for other in objects), default=0) <= ignore:
                                losses["objectness"] += entropy(0, t[4])
                                delta[4] = sigmoid(t[4])
                            continue
                        losses["objectness"] += entropy(1, t[4])
                        delta[4] = sigmoid(t[4]) - 1
                        for k in range(3):
                            losses["classes"] += entropy(float(thing[4] == k + 1), t[5 + k])
                            delta[5 + k] = sigmoid(t[5 + k]) - float(thing[4] == k + 1)
                        weight = 2 - thing[2] * thing[3] / (CANVAS[0] * CANVAS[1])
                        x = (thing[0] * columns / CANVAS[0] - column + move) / head.scale
                        y = (thing[1] * rows / CANVAS[1] - row + move) / head.scale
                        wide, high = math.log(thing[2] / pw), math.log(thing[3] / ph)
                        losses["boxes"] += weight * (entropy(x, t[0]) + entropy(y, t[1]))
                        losses["boxes"] += weight * ((t[2] - wide) ** 2 + (t[3] - high) ** 2) / 2
                        errors = [sigmoid(t[0]) - x, sigmoid(t[1]) - y, t[2] - wide, t[3] - high]
                        delta[:4] = torch.tensor([weight * error for error in errors])
    return losses, deltas


def problem(seed, images=3, dtype=torch.float64):
    """Random maps, boxes and labels; one image has no objects."""
    generator = torch.Generator().manual_seed(seed)
    maps = [torch.randn(images, 16, *size, generator=generator, dtype=dtype) for size in SIZES]
    boxes, labels = [], []
    for image in range(images):
        count = 0 if image == 1 else 4
        corner = torch.rand(count, 2, generator=generator, dtype=dtype) * torch.tensor([40.0, 20.0])
        size = torch.rand(count, 2, generator=generator, dtype=dtype) * torch.tensor([24.0, 12.0]) + 0.5
        boxes.append(torch.cat([corner, corner + size], -1))
        labels.append(torch.randint(1, 4, (count,), generator=generator))
    return maps, boxes, labels


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("ignore", [0.1, 0.5])
def test_loss_and_gradient_match_darknet(seed, ignore):
    maps, boxes, labels = problem(seed)
    maps = [raw.requires_grad_() for raw in maps]
    losses = yolo_loss(maps, HEADS, CANVAS, boxes, labels, ignore=ignore)
    wanted, deltas = loss_by_loop([raw.detach() for raw in maps], boxes, labels, ignore)
    for name, value in wanted.items():
        assert getattr(losses, name).item() == pytest.approx(value, rel=1e-9), name
    for gradient, delta in zip(torch.autograd.grad(losses.total, maps), deltas, strict=True):
        torch.testing.assert_close(gradient, delta, rtol=1e-6, atol=1e-6)


def test_a_low_overlap_threshold_ignores_some_boxes():
    maps, boxes, labels = problem(0)
    strict, lenient = (yolo_loss(maps, HEADS, CANVAS, boxes, labels, ignore=ignore) for ignore in (0.1, 1.0))
    assert strict.objectness < lenient.objectness
    assert strict.classes == lenient.classes > 0


def test_the_last_of_two_objects_assigned_to_one_box_counts_even_at_the_border():
    box = [24.0, 20.0, 64.0, 48.0]  # its centre is below the canvas
    boxes, labels = [torch.tensor([box, box], dtype=torch.float64)], [torch.tensor([1, 3])]
    maps = [raw[:1] for raw in problem(1)[0]]
    losses = yolo_loss(maps, HEADS, CANVAS, boxes, labels)
    wanted, _ = loss_by_loop(maps, boxes, labels, 0.5)
    assert losses.classes.item() == pytest.approx(wanted["classes"])
    alone = yolo_loss(maps, HEADS, CANVAS, [boxes[0][1:]], [labels[0][1:]])
    assert losses.total.item() == pytest.approx(alone.total.item())


def test_an_anchor_that_two_heads_share_is_trained_in_both():
    maps = [torch.zeros(1, 16, *size, requires_grad=True) for size in SIZES]
    losses = yolo_loss(maps, HEADS, CANVAS, [torch.tensor([[10.0, 4.0, 30.0, 16.0]])], [torch.tensor([2])])
    gradients = torch.autograd.grad(losses.classes, maps)
    assert [int((gradient != 0).sum()) for gradient in gradients] == [3, 3]


def test_gradients_equal_finite_differences():
    maps, boxes, labels = problem(2, images=2)
    maps = [raw.requires_grad_() for raw in maps]

    def loss(*maps):
        return yolo_loss(maps, HEADS, CANVAS, boxes, labels).total

    assert torch.autograd.gradcheck(loss, maps)


def test_the_loss_of_a_perfect_box_is_its_entropy():
    """The box is centred in its cell and as large as its anchor: only the entropy of two offsets of 0.5 is left."""
    head = Head(((16.0, 16.0),), 1)
    raw = torch.full((1, 6, 2, 2), -50.0, dtype=torch.float64)
    raw[0, :4, 0, 0], raw[0, 4:, 0, 0] = 0.0, 50.0
    losses = yolo_loss([raw], [head], (32, 32), [torch.tensor([[0.0, 0.0, 16.0, 16.0]])], [torch.tensor([1])])
    assert losses.boxes.item() == pytest.approx((2 - 0.25) * 2 * math.log(2))
    assert losses.objectness.item() == pytest.approx(0, abs=1e-12)
    assert losses.classes.item() == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_loss_keeps_dtype_and_device(dtype, device):
    maps, boxes, labels = problem(3, dtype=dtype)
    arguments = [[each.to(device) for each in many] for many in (maps, boxes, labels)]
    losses = yolo_loss(arguments[0], HEADS, CANVAS, *arguments[1:])
    assert (losses.total.dtype, losses.total.device.type) == (dtype, device.type)
    expected = yolo_loss([raw.double() for raw in maps], HEADS, CANVAS, [box.double() for box in boxes], labels)
    assert losses.total.item() == pytest.approx(expected.total.item(), rel=1e-5)


def test_the_loss_of_a_batch_is_the_sum_over_its_images():
    maps, boxes, labels = problem(4)
    whole = yolo_loss(maps, HEADS, CANVAS, boxes, labels)
    parts = [
        yolo_loss([raw[n : n + 1] for raw in maps], HEADS, CANVAS, boxes[n : n + 1], labels[n : n + 1])
        for n in range(3)
    ]
    assert (parts[0] + parts[1] + parts[2]).total.item() == pytest.approx(whole.total.item())


def test_gradient_descent_learns_the_position_and_class_of_an_object():
    """A network of one layer is trained with the loss."""
    torch.manual_seed(0)
    head = Head(((12.0, 12.0),), 2)
    layer = torch.nn.Conv2d(4, head.channels, 1)
    image, box, label = torch.randn(1, 4, 2, 2), [torch.tensor([[17.0, 2.0, 30.0, 14.0]])], [torch.tensor([2])]
    optimiser = torch.optim.Adam(layer.parameters(), lr=0.1)
    for _ in range(200):
        optimiser.zero_grad()
        raw = functional_call(layer, dict(layer.named_parameters()), (image,))
        yolo_loss([raw], [head], (32, 32), box, label).total.backward()
        optimiser.step()
    scores = layer(image)[0, 4:].sigmoid()
    assert scores[0].flatten().tolist() == pytest.approx([0, 1, 0, 0], abs=0.1)
    assert scores[1:, 0, 1].tolist() == pytest.approx([0, 1], abs=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"maps": 1}, "maps: expected one for each of 2 heads, got 1"),
        ({"labels": 1}, "labels: expected one tensor for each of 3 images, got 1"),
        ({"boxes": 2}, "labels: expected one tensor for each of 2 images, got 3"),
    ],
)
def test_a_wrong_number_of_maps_boxes_or_labels_is_refused(change, message):
    names = ("maps", "boxes", "labels")
    given = {name: each[: change.get(name, len(each))] for name, each in zip(names, problem(0), strict=True)}
    with pytest.raises(InputError, match=message):
        yolo_loss(given["maps"], HEADS, CANVAS, given["boxes"], given["labels"])


def test_maps_that_do_not_fit_the_heads_are_refused():
    maps, boxes, labels = problem(0)
    with pytest.raises(InputError, match="maps: expected a tensor of shape"):
        yolo_loss([maps[0][:, :15], maps[1]], HEADS, CANVAS, boxes, labels)
