"""Torch modules of other libraries: the library that one is from, and a digest of its weights."""

import hashlib

import torch
from torch import nn


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
