"""Tensors on disk that can always be computed again: whole, of the right origin, or not there."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from semfov.files import replacing


def write_tensors(path: Path, key: str, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors atomically, with a checksum and the key of what they depend on."""
    whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
    content = save(whole, {"key": key, "sha256": checksum(whole)})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_tensors(path: Path, key: str) -> dict[str, Tensor] | None:
    """Tensors that `write_tensors` wrote under this key; None where they are missing, damaged or of another key."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (OSError, SafetensorError):
        return None
    return tensors if metadata == {"key": key, "sha256": checksum(tensors)} else None


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """sha256 over names, shapes, types and bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name}{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
