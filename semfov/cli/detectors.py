"""Subcommand detectors: lists the detectors that can be named, or the classes of one."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from os import fspath
from pathlib import Path
from typing import Any

from semfov.agent import ActivePerception
from semfov.belief import Verification
from semfov.cli.agent import check_onnx_options, detector_options, remember
from semfov.cli.options import DetectorsOptions
from semfov.cli.outcome import padded, table_lines, terminal_columns
from semfov.cli.trial import try_detector
from semfov.detection.load import check_detector, load_detector
from semfov.detection.weights import WEIGHTS, weights_path
from semfov.errors import check
from semfov.gaze.saliency import FixationDensity
from semfov.io.compatibility import searching_for
from semfov.io.files import cache_folder
from semfov.io.manifest import Manifest
from semfov.io.pretrained import Pretrained
from semfov.observation.foveal import FovealObservationModel
from semfov.zoom import GlimpseEvidence

_PURPOSES: dict[str, tuple[type[Pretrained], Callable[[str], str]]] = {
    "search": (FovealObservationModel, searching_for),
    "closer looks": (Verification, str),
    "explore": (FovealObservationModel, str),
    "large pictures": (GlimpseEvidence, str),
    "gaze": (FixationDensity, str),
}
"""Models that are shipped for some detectors, by what they are for: their kind, and their name for a detector's."""

_WIDTH = 100  # characters of a line of names


def _show_one(options: DetectorsOptions, path: Path) -> int:
    """List the classes of a detector, or try it out in a photograph."""
    name = fspath(path)
    loading = detector_options(options)
    classes = Manifest.read(path).classes if path.is_dir() else _classes_of(name, options, loading)
    written = remember(options, name)
    if written is not None:
        print(f"wrote {written}")
    if options.try_ is not None:
        is_fitted = path.is_dir() or (GlimpseEvidence.shipped / f"{name}.safetensors").is_file()
        make = ActivePerception.from_pretrained if is_fitted else ActivePerception.raw
        try_detector(make(name, **loading), options.try_)
        return 0
    print("\n".join([f"{name} knows {len(classes)} classes:", *_in_columns(classes)]))
    return 0


def _classes_of(name: str, options: DetectorsOptions, loading: Mapping[str, Any]) -> Sequence[str]:
    """Find the classes of a detector; one whose classes are registered is loaded only to try the options."""
    check_onnx_options(options, name)
    registered = check_detector(name)
    if registered is None or loading:
        return load_detector(name, **loading).classes
    return registered


def _in_columns(names: Sequence[str]) -> list[str]:
    """Write names in columns, in order down each of them, in lines of at most `_WIDTH` characters."""
    width = max(map(terminal_columns, names)) + 2  # with two blanks between columns
    columns = max(1, _WIDTH // width)
    rows = -(-len(names) // columns)  # rounded up
    lines = []
    for row in range(rows):
        cells = [padded(name, width) for name in names[row::rows]]
        lines.append("".join(cells).rstrip())
    return lines


def show(options: DetectorsOptions) -> int:
    """List the detectors, or the classes of one, or try one out.

    Args:
        options: the options of the command.

    Returns:
        The exit code.
    """
    if options.name is not None:
        return _show_one(options, options.name)
    for name in ("try_", "remember"):
        check(not getattr(options, name), name.strip("_"), "the name or the file of a detector before it", "none")
    rows = [["name", "size", "weights", "models shipped for", "licence"]]
    for name, weights in WEIGHTS.items():
        purposes = ", ".join(_purposes(name)) or "none"
        rows.append([name, f"{weights.size / 1e6:.0f} MB", _place_of_weights(name), purposes, weights.licence])
    print("\n".join(table_lines(rows)))
    print(f"\nDownloaded weights are kept in {cache_folder()}.")
    print("Others: torchvision:MODEL, hf:OWNER/NAME, a .onnx file, a .cfg and its weights, or a folder of semfov fit.")
    print("A detector without shipped models runs with --agent raw, or after semfov fit.")
    return 0


def _place_of_weights(name: str) -> str:
    """Say where the weights of a registered detector are, or come from."""
    if weights_path(name).is_file():
        return "here"
    return "downloaded when needed" if WEIGHTS[name].sources else "given by --weights"


def _purposes(name: str) -> Iterator[str]:
    """Yield what models are shipped for, of those of a detector."""
    for purpose, (kind, model) in _PURPOSES.items():
        if (kind.shipped / f"{model(name)}.safetensors").is_file():
            yield purpose
