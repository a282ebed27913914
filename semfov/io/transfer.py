"""Tensors as bytes, which a worker on any machine can send; nothing in them is executed."""

from collections.abc import Mapping

from torch import Tensor


def pack_tensors(tensors: Mapping[str, Tensor]) -> bytes:
    """Convert tensors to bytes in the safetensors format.

    Args:
        tensors: tensors by name, of any shape and type.

    Returns:
        The bytes.

    >>> import torch
    >>> unpack_tensors(pack_tensors({"a": torch.tensor([1.5])}))
    {'a': tensor([1.5000])}
    """
    from safetensors.torch import save

    # A view of a larger tensor may share its memory with another one, which the format refuses.
    return save({name: tensor.detach().cpu().clone().contiguous() for name, tensor in tensors.items()})


def unpack_tensors(data: bytes) -> dict[str, Tensor]:
    """Convert the bytes of `pack_tensors` back to tensors.

    Args:
        data: the bytes.

    Returns:
        The tensors by name.
    """
    from safetensors.torch import load

    return load(data)
