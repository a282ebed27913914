"""Detectors from torch modules of other libraries: torchvision, transformers, Ultralytics."""

import hashlib
from typing import Any

import torch
from torch import nn

from semfov.detection.detector import Detector
from semfov.errors import InputError


def module_digest(module: nn.Module) -> str:
    """Compute the sha256 of the names and values of a module's parameters and buffers.

    Args:
        module: the module.

    Returns:
        64 hexadecimal digits.

    >>> layer = nn.Linear(2, 1)
    >>> module_digest(layer) == module_digest(layer), module_digest(layer) == module_digest(nn.Linear(2, 1))
    (True, False)
    """
    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        if isinstance(tensor, torch.Tensor):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def comes_from(module: object, package: str) -> bool:
    """Tell whether the class of an object, or a class that it inherits from, is defined in a package.

    Args:
        module: the object.
        package: name of the package, which is not imported.

    Returns:
        Whether it is.

    >>> comes_from(nn.Linear(1, 1), "torch.nn"), comes_from(nn.Linear(1, 1), "torchvision")
    (True, False)
    """
    return any(f"{kind.__module__}.".startswith(f"{package}.") for kind in type(module).__mro__)


def load_module(module: nn.Module, **options: Any) -> Detector:
    """Make a detector of a torch module of another library; its library is recognised by the module of its class.

    The module itself is used, not a copy, and set to `eval` mode.

    Args:
        module: a detection model of torchvision, an object detection model of transformers, or a model of Ultralytics.
        options: options of `wrap_torchvision`, `wrap_transformers` or `wrap_ultralytics`.

    Returns:
        The detector, in `eval` mode.

    Raises:
        InputError: the library is unknown, or an option does not fit the module.
    """
    if comes_from(module, "torchvision.models.detection"):
        from semfov.detection.torchvision import wrap_torchvision

        return wrap_torchvision(module, **options)
    if comes_from(module, "transformers.models"):
        from semfov.detection.transformers import wrap_transformers

        return wrap_transformers(module, **options)
    if comes_from(module, "ultralytics"):
        from semfov.detection.ultralytics import wrap_ultralytics

        return wrap_ultralytics(module, **options)
    raise InputError(
        f"detector: expected a model of torchvision, transformers or Ultralytics, got {type(module).__module__}."
        f"{type(module).__qualname__}; write a class with the method propose (semfov.Detector), or export it to ONNX"
    )
