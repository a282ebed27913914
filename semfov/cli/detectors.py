"""Subcommand detectors: lists the detectors that can be named, or the classes of one."""

from os import fspath

from semfov.belief import MapEvidence, TargetEvidence, Verification
from semfov.cli.options import DetectorsOptions
from semfov.cli.outcome import table_lines
from semfov.detection.load import check_detector, load_detector
from semfov.detection.weights import WEIGHTS, cache_folder, weights_path
from semfov.gaze.saliency import FixationDensity
from semfov.io.manifest import Manifest
from semfov.io.pretrained import Pretrained
from semfov.zoom import GlimpseEvidence

_PURPOSES: dict[str, type[Pretrained]] = {
    "search": TargetEvidence,
    "closer looks": Verification,
    "explore": MapEvidence,
    "large pictures": GlimpseEvidence,
    "gaze": FixationDensity,
}
"""Models that are shipped for some detectors, by what they are for."""

_WIDTH = 100  # characters of a line of names


def show(options: DetectorsOptions) -> int:
    """List the detectors, or the classes of one."""
    if options.name is not None:
        name = fspath(options.name)
        classes = Manifest.read(options.name).classes if options.name.is_dir() else check_detector(name)
        classes = load_detector(name).classes if classes is None else classes
        print(f"{name} knows {len(classes)} classes:")
        wide = max(map(len, classes)) + 2
        down = -(-len(classes) // max(1, _WIDTH // wide))
        for row in range(down):  # in order down each column
            print("".join(each.ljust(wide) for each in classes[row::down]).rstrip())
        return 0
    rows = [["name", "size", "weights", "models shipped for", "licence"]]
    for name, weights in WEIGHTS.items():
        elsewhere = "downloaded when needed" if weights.sources else "given by --weights"
        there = "here" if weights_path(name).is_file() else elsewhere
        models = [what for what, kind in _PURPOSES.items() if (kind.shipped / f"{name}.safetensors").is_file()]
        rows.append([name, f"{weights.size / 1e6:.0f} MB", there, ", ".join(models) or "none", weights.licence])
    print("\n".join(table_lines(rows)))
    print(f"\nDownloaded weights are kept in {cache_folder()}.")
    print("Others: torchvision:MODEL, hf:OWNER/NAME, a .onnx file, a .cfg and its weights, or a folder of semfov fit.")
    print("A detector without shipped models runs with --agent raw, or after semfov fit.")
    return 0
