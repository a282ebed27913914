"""Fuzz the fields of model files with a correct checksum: impossible values are refused by name."""

import copy
import json
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.fuzz.runner import attempt, choose, draw_rng, failed, outcome
from semfov import FovealObservationModel, TargetEvidence
from semfov.belief import ContextPrior
from semfov.io import storage
from semfov.io.pretrained import Pretrained

CLASSES = ["cup", "cat"]
JUNK: list[Any] = [
    None, True, False, -1, 0, 1, 2, 3, 10**9, 10**400, 0.5, 1.5, -0.5, "", "x", "\0", [], [None], [1], [1, 2], [0.1],
    ["a", "b"], ["a", "a"], {}, {"a": 1}, {"confirm": 2, "give_up": 0}, {"confirm": 0.5}, [[1, 2]], {"x": [1, "y"]},
]  # fmt: skip


def model_fields(data: st.DataObject) -> str:
    """Every model with a changed tensor or value: it is refused, or the loaded model is exactly what the file says."""
    rng = draw_rng(data)
    make = choose(data, _MODELS, "model")
    model = make()
    kind = type(model)
    tensors = {name: tensor.detach().clone() for name, tensor in model._tensors().items()}
    record = json.loads(json.dumps({"kind": kind.kind, "version": "0", **model._record(), "metadata": model.metadata}))
    damage = choose(data, ("none", "number", "dtype", "shape", "missing", "more", "value", "absent", "unsigned"), "how")
    must = damage in ("dtype", "shape", "more", "unsigned")
    if damage in ("number", "dtype", "shape", "missing"):
        name = choose(data, list(tensors), "tensor")
        must |= damage == "missing" and not kind.schema.tensors[name].optional
        tensors = _spoiled(data, tensors, name, damage, rng)
        must |= any(not bool(tensor.double().isfinite().all()) for tensor in tensors.values())
    elif damage == "more":
        tensors["more"] = torch.zeros(2)
    elif damage in ("value", "absent"):
        key = choose(data, [key for key in record if key != "kind"], "key")
        record[key] = copy.deepcopy(choose(data, JUNK, "junk"))
        if damage == "absent":
            del record[key]
            must = key != "thresholds"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "model.safetensors")
        storage.write_file(path, tensors, record)
        if damage == "unsigned":
            from safetensors.torch import save_file

            save_file(tensors, path, {"semfov": json.dumps(record)})
        result = attempt(lambda: kind.from_pretrained(path))
    if failed(result):
        assert damage != "none", result
        return outcome(result)
    assert not must, f"{damage} was let through"
    assert isinstance(result, Pretrained)
    for name, tensor in result._tensors().items():
        assert torch.equal(tensor, tensors[name]), name
        assert bool(tensor.isfinite().all())
    restored = json.loads(json.dumps({**result._record(), "metadata": result.metadata}))
    assert all(restored[key] == record[key] for key in restored if key in record), damage
    if isinstance(result, FovealObservationModel):
        assert 0 < float(result.tempering) <= 100
        assert result.miss_rate is None or bool(((result.miss_rate >= 0) & (result.miss_rate <= 1)).all())
        calibrated = result.calibrate(torch.tensor([0.2, 0.7, 0.1]), torch.tensor(0.1)).detach()
        assert bool(calibrated.isfinite().all())
        assert abs(float(calibrated.sum()) - 1) < 1e-4
    return "result"


def _spoiled(data: st.DataObject, tensors: dict[str, Tensor], name: str, damage: str, rng: Any) -> dict[str, Tensor]:
    tensor = tensors[name]
    if damage == "missing":
        return {key: value for key, value in tensors.items() if key != name}
    if damage == "number":
        number = choose(data, (torch.nan, torch.inf, -torch.inf, 0.0, -1.0, 1.5, 60.0, 200.0, 6e4, -6e4), "number")
        tensor.view(-1)[int(rng.integers(tensor.numel()))] = number
    elif damage == "dtype":
        kinds = [torch.bfloat16, torch.int64, torch.bool, torch.uint8, torch.int8]
        tensor = tensor.to(choose(data, kinds, "dtype"))
    else:
        tensor = choose(data, (tensor[None].clone(), tensor.new_zeros(0), tensor.new_zeros(2, 3, 4, 5, 6)), "shape")
    return {**tensors, name: tensor}


def _observation() -> Pretrained:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return FovealObservationModel.identity(
            CLASSES,
            [0.2],
            expected=torch.full((3, 2, 3), 1 / 3),
            miss_rate=torch.full((3, 2), 0.25),
            tempering=0.5,
            metadata={"detector": {"name": "toy"}},
        )


def _evidence() -> Pretrained:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return TargetEvidence(2, 3, components=3)


def _context() -> Pretrained:
    return ContextPrior(CLASSES, torch.zeros(3, 2, 2), torch.zeros(3, 3, 2), [0.1], weights={"map": (1.0, 0.5)})


_MODELS: tuple[Callable[[], Pretrained], ...] = (_observation, _evidence, _context)
