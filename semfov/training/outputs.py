"""What every fit leaves: what the model says of its training, a report, the settings, and the report's figures."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from semfov.data.scene import Scenes
from semfov.experiments.setup import plain
from semfov.io.files import inside, write_text


def training_of(config: Any, scenes: Scenes, *besides: str) -> dict[str, Any]:
    """What a model keeps of its training: the photographs, and the settings that it depends on.

    Detector and sensor are not among them, nor where files lie: they are told by `Eye.settings()`.

    Args:
        config: dataclass of the settings.
        scenes: the photographs.
        besides: further settings that the model does not depend on.
    """
    left_out = {"out", "cache", "workers", "data", "detector", "sensor", *besides}
    settings = {name: value for name, value in plain(asdict(config)).items() if name not in left_out}
    return {"data": scenes.fingerprint, "training": settings}


def model_path(config: Any, detector: str) -> Path:
    """Where a fitted model is written: under its name in the settings, or the detector's, in `config.out`."""
    return inside(config.out, f"{config.name or detector}.safetensors")


def write_outputs(config: Any, report: str, figures: tuple[str, str], model: Path | None = None) -> None:
    """Print the report, write it, the settings and the figures to `config.out`, and name all that was written.

    Args:
        config: dataclass of the settings.
        report: Markdown.
        figures: name of a JSON file, and its text.
        model: file that was written before, to be named too.
    """
    files = {
        "report.md": report,
        "config.yaml": yaml.safe_dump(plain(asdict(config)), sort_keys=False),
        figures[0]: figures[1],
    }
    print(report)
    for name, text in files.items():
        write_text(inside(config.out, name), text)
    written = [*([] if model is None else [model]), *(config.out / name for name in files)]
    print("written:", *(f"  {path}" for path in written), sep="\n")
