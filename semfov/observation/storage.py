"""Tensors and what they mean in one file: safetensors with a JSON record in its header."""

import json
from collections.abc import Mapping
from os import PathLike
from pathlib import Path
from typing import Any

from torch import Tensor

from semfov.errors import DataError
from semfov.files import replacing

# One key only: the order of several would differ from one write to the next.
_KEY = "semfov"


def write(path: str | PathLike[str], tensors: Mapping[str, Tensor], record: Mapping[str, Any]) -> None:
    """Write tensors and a record of JSON values to a file, whole or not at all; the same content gives the same bytes.

    Raises:
        DataError: the file cannot be written.
    """
    from safetensors.torch import save_file

    header = {_KEY: json.dumps(record, sort_keys=True, allow_nan=False)}
    with replacing(Path(path)) as temporary:
        save_file({name: t.detach().cpu().contiguous() for name, t in tensors.items()}, temporary, header)


def read(path: str | PathLike[str], kind: str) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and record of a file that `write` made; nothing in the file is executed.

    Args:
        path: the file.
        kind: what the record must say under `kind`.

    Raises:
        DataError: the file is missing, damaged, or of another kind.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            record = json.loads((file.metadata() or {})[_KEY])
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a dict)
    except FileNotFoundError:
        raise DataError(f"{path}: no such file") from None
    except (OSError, SafetensorError, ValueError) as error:
        raise DataError(f"{path}: not a readable safetensors file ({error}); write or fetch it again") from None
    except KeyError:
        raise DataError(f"{path}: expected a file that semfov wrote, got one without its record") from None
    if not isinstance(record, dict) or record.get("kind") != kind:
        found = record.get("kind") if isinstance(record, dict) else type(record).__name__
        raise DataError(f"{path}: expected {kind}, got {found}")
    return tensors, record
