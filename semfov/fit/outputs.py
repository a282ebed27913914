"""The outputs of every fit: metadata about the training, a report, the settings, and the report's measures as JSON."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from semfov.data.scene import Scenes
from semfov.io.files import inside, write_text
from semfov.runs.setup import plain


def training_of(config: Any, scenes: Scenes, *besides: str) -> dict[str, Any]:
    """Build the metadata of a model about its training: the photographs, and the settings that the model depends on.

    The settings of detector and sensor are left out, because `Eye.settings()` provides them. Paths are left out too.

    Args:
        config: dataclass of the settings.
        scenes: the photographs.
        besides: further settings to leave out, because the model does not depend on them.

    Returns:
        The metadata.
    """
    left_out = {"out", "cache", "workers", "data", "detector", "sensor", *besides}
    settings = {name: value for name, value in plain(asdict(config)).items() if name not in left_out}
    return {"data": scenes.fingerprint, "training": settings}


def model_path(config: Any, detector: str) -> Path:
    """Return the file of a fitted model in `config.out`, named after the settings' `name` or else the detector."""
    return inside(config.out, f"{config.name or detector}.safetensors")


def write_outputs(config: Any, report: str, figures: tuple[str, str], model: Path | None = None) -> None:
    """Print the report, write it with the settings and the measures to `config.out`, and list the written files.

    Args:
        config: dataclass of the settings.
        report: the report in Markdown.
        figures: name and content of a JSON file with the measures.
        model: file of the model, already written, to include in the list.
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
