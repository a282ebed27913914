"""Settings of an ONNX model, from its metadata or from a JSON file in the same folder."""

import ast
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from semfov.detection.onnx_file import MOST_METADATA
from semfov.errors import DataError
from semfov.io.files import check_regular
from semfov.io.schema import excerpt, is_number, is_plain

METADATA_KEY = "semfov"
"""Key of the settings, as JSON, in the metadata of models that semfov exports."""

KEYS: dict[str, tuple[type, ...]] = {
    "name": (str,),
    "head": (str,),
    "classes": (list,),
    "input_size": (int, list),
    "stride": (int, type(None)),
    "background": (str,),
    "logits": (bool,),
    "preprocessing": (dict,),
    "licence": (str,),
    "source": (str,),
}
"""Keys of a settings file, with the types of their values; `licence` and `source` are for people."""


def read_settings(path: Path, metadata: Mapping[str, str]) -> dict[str, Any]:
    """Read the settings of a model.

    Settings in `model.json` in the folder of `model.onnx` override settings in the model's metadata. The metadata of
    models that semfov or Ultralytics (class names, input size) have exported are understood.

    Args:
        path: path of the model.
        metadata: metadata of the model.

    Returns:
        The settings by name.

    Raises:
        DataError: the file is not a JSON object, or has a key that is not one of `KEYS`.
    """
    beside = path.with_suffix(".json")
    inside = _parse(metadata[METADATA_KEY], f"metadata of {path.name}") if METADATA_KEY in metadata else {}
    outside = _parse(_read(beside), str(beside)) if beside.exists() else {}
    preprocessing = {**inside.get("preprocessing", {}), **outside.get("preprocessing", {})}
    return {**_ultralytics(metadata), **inside, **outside, "preprocessing": preprocessing}


def _read(path: Path) -> str:
    check_regular(path)
    if path.stat().st_size > MOST_METADATA:
        raise DataError(f"{path}: expected at most {MOST_METADATA:,} bytes, got {path.stat().st_size:,}")
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"cannot read {path}: {error}") from error


def _parse(text: str, where: str) -> dict[str, Any]:
    try:
        settings = json.loads(text)
    except json.JSONDecodeError as error:
        raise DataError(f"{where}: expected JSON, got an error in line {error.lineno}: {error.msg}") from error
    except (ValueError, RecursionError):  # integers too long, lists too deep
        raise DataError(f"{where}: expected JSON, got numbers that are too long or lists that are too deep") from None
    if not isinstance(settings, dict):
        raise DataError(f"{where}: expected an object, got {excerpt(settings)}")
    unknown = sorted(set(settings) - set(KEYS))
    if unknown:
        raise DataError(f"{where}: unknown key {', '.join(unknown)[:80]!a}; known: {', '.join(KEYS)}")
    for key, value in settings.items():
        if not isinstance(value, KEYS[key]):
            kinds = " or ".join(kind.__name__ for kind in KEYS[key])
            raise DataError(f"{where}: {key}: expected {kinds}, got {excerpt(value)}")
    names, size = settings.get("classes", []), settings.get("input_size", 1)
    if not all(isinstance(name, str) and is_plain(name) for name in names):
        raise DataError(f"{where}: classes: expected names without control characters, got {excerpt(names)}")
    for number in size if isinstance(size, list) else [size]:
        if not is_number(number, whole=True):
            raise DataError(f"{where}: input_size: expected whole numbers, got {excerpt(size)}")
    return settings


def _ultralytics(metadata: Mapping[str, str]) -> dict[str, Any]:
    """Class names `{0: 'person', ...}` and input size `[height, width]` from Ultralytics' metadata."""
    settings: dict[str, Any] = {}
    try:
        if "names" in metadata:
            names = ast.literal_eval(metadata["names"])
            settings["classes"] = [names[i] for i in range(len(names))]
            if not all(isinstance(name, str) and is_plain(name) for name in settings["classes"]):
                return {}
        if "imgsz" in metadata:
            height, width = ast.literal_eval(metadata["imgsz"])
            settings["input_size"] = [int(width), int(height)]
    except (ValueError, SyntaxError, TypeError, KeyError, IndexError, RecursionError, MemoryError, OverflowError):
        return {}  # keys of the same name from another exporter
    return settings
