"""Tensors on disk that can always be computed again: whole, of the right origin, or not there."""

import hashlib
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from semfov.files import replacing


def write_tensors(path: Path, key: str, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors atomically, with a checksum, the key of what they depend on, and the name of their file."""
    whole = {name: tensor.contiguous() for name, tensor in tensors.items()}
    content = save(whole, {"key": key, "sha256": checksum(whole), "file": path.name})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_tensors(path: Path, key: str) -> dict[str, Tensor] | None:
    """Tensors that `write_tensors` wrote to this file under this key; None where they are missing or damaged.

    A file that was written under another key or by another name, such as that of another scene, counts as missing.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except (OSError, SafetensorError):
        return None
    # Files of before names were kept have none.
    wanted = {"key": key, "sha256": checksum(tensors), "file": path.name}
    return tensors if {"file": path.name, **metadata} == wanted else None


def checksum(tensors: Mapping[str, Tensor]) -> str:
    """sha256 over names, shapes, types and bytes."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name}{tuple(tensor.shape)}{tensor.dtype}".encode())
        digest.update(tensor.contiguous().numpy().tobytes())
    return digest.hexdigest()
