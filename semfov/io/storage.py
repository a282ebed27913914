"""Tensors and their description in one file: safetensors with a JSON record in the header, and a checksum over both."""

import hashlib
import json
import re
from collections.abc import Mapping
from os import PathLike
from pathlib import Path

import torch
from torch import Tensor

from semfov.errors import DataError, reason_of
from semfov.io.files import JsonObject, check_regular, write_bytes
from semfov.io.schema import Schema
from semfov.version import __version__

# A single key, because the order of several keys would differ from one write to the next.
_KEY = "semfov"
_CHECKSUM = "sha256"


def write_file(path: str | PathLike[str], tensors: Mapping[str, Tensor], record: Mapping[str, object]) -> None:
    """Write tensors and a record to a file atomically; the same content gives the same bytes.

    Args:
        path: the file.
        tensors: by name.
        record: JSON values by name.

    Raises:
        DataError: it cannot be written.
    """
    from safetensors.torch import save

    stored = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    verified = {**record, _CHECKSUM: checksum(stored, record)}
    header = {_KEY: json.dumps(verified, sort_keys=True, allow_nan=False)}
    content = save(stored, header)
    # The file is written here, because `safetensors` reports a full disk by an error that is not an `OSError`.
    write_bytes(path, content)


def read(path: str | PathLike[str], kind: str) -> tuple[dict[str, Tensor], JsonObject]:
    """Read a file that `write_file` made, and verify its checksum; nothing in the file is executed.

    Args:
        path: the file.
        kind: the value `kind` of its record.

    Returns:
        Tensors and record.

    Raises:
        DataError: it is missing, damaged, of another kind or of a later version.
    """
    tensors, record = _read_unverified(path)
    if not isinstance(record, dict) or record.get("kind") != kind:
        got = record.get("kind") if isinstance(record, dict) else type(record).__name__
        raise DataError(f"{path}: expected a file of kind {kind}, got {got}; check the path")
    recorded = record.pop(_CHECKSUM, None)
    if recorded is None:
        raise DataError(f"{path}: expected a file with the sha256 of its content, got one without; write it again")
    if recorded != checksum(tensors, record):
        raise DataError(f"{path}: damaged, its sha256 is not the one it was written with; fetch it again")
    check_version(path, record)
    return tensors, record


def kind_of_file(path: str | PathLike[str]) -> str:
    """Tell which kind of file it is that `write_file` wrote, without verifying it.

    Args:
        path: the file.

    Returns:
        The kind, such as `foveal-observation-model`; empty where the file does not say.

    Raises:
        DataError: the file is missing, or is none that semfov wrote.
    """
    _, record = _read_unverified(path)
    return str(record.get("kind", "")) if isinstance(record, dict) else ""


def _read_unverified(path: str | PathLike[str]) -> tuple[dict[str, Tensor], object]:
    """Read the tensors of a safetensors file, and the JSON value of its record."""
    from safetensors import SafetensorError, safe_open

    check_regular(path)
    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            record = json.loads(header[_KEY], parse_constant=int)  # refuses NaN
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file; check the path") from None
    except (OSError, SafetensorError, ValueError, RecursionError, TypeError, AttributeError, RuntimeError) as error:
        reason = reason_of(error)
        raise DataError(f"{path}: not a readable safetensors file ({reason}); write or fetch it again") from None
    except KeyError:
        raise DataError(f"{path}: expected a file that semfov wrote, got one without its record") from None
    return tensors, record


def check_version(path: str | PathLike[str], record: Mapping[str, object]) -> None:
    """Refuse a file of a later version; that of a correction (its third number) has the same form.

    Args:
        path: the file.
        record: its record.

    Raises:
        DataError: the version is later.
    """
    written = str(record.get("version", ""))
    if _form(written) > _form(__version__):
        raise DataError(f"{path}: written by semfov {written}, which is newer than this one, {__version__}; update it")


def _form(version: str) -> list[int]:
    """Take the first two numbers of a version."""
    return [int(number) for number in re.findall(r"\d{1,9}", version)[:2]]


def checksum(tensors: Mapping[str, Tensor], record: Mapping[str, object] | None = None) -> str:
    """Compute a sha256 over the record and over the names, shapes, types and bytes of the tensors.

    Args:
        tensors: by name.
        record: JSON values by name; None for none.

    Returns:
        Hexadecimal digits.
    """
    digest = hashlib.sha256(json.dumps(record or {}, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name} {tuple(tensor.shape)} {tensor.dtype}".encode())
        content = tensor.reshape(-1).view(torch.uint8)  # NumPy does not have all types of torch, such as bfloat16
        digest.update(content.numpy().tobytes())
    return digest.hexdigest()


_KIND = "cached-tensors"


def write_tensors(path: Path, key: str, tensors: Mapping[str, Tensor]) -> None:
    """Write tensors atomically, with a checksum.

    Args:
        path: the file.
        key: of the inputs that the tensors depend on; it is kept with them, and so is the name of the file.
        tensors: by name.

    Raises:
        DataError: the file cannot be written.
    """
    write_file(path, tensors, {"kind": _KIND, "key": key, "file": path.name})


def read_tensors(path: Path, key: str, schema: Schema | None = None) -> dict[str, Tensor] | None:
    """Read the tensors that `write_tensors` wrote.

    Args:
        path: the file.
        key: of the inputs that the tensors depend on.
        schema: requirements of the tensors; None for none.

    Returns:
        The tensors; None where they are damaged, or were written under another key or to another file.
    """
    try:
        tensors, record = read(path, _KIND)
        if schema is not None:
            schema.check(tensors)
    except Exception:  # whatever is wrong with the file, its tensors can be computed again
        return None
    return tensors if (record.get("key"), record.get("file")) == (key, path.name) else None


def pack_tensors(tensors: Mapping[str, Tensor]) -> bytes:
    """Convert tensors to bytes in the safetensors format.

    Args:
        tensors: by name.

    Returns:
        The bytes.
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
