"""What fits write: the model, a report, and the settings and measures."""

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from semfov.fit.settings import FitOnLooksConfig
from semfov.fit.training import Fit
from semfov.io.files import inside, write_text
from semfov.runs.looking import Looking
from semfov.runs.scene_run import finish


def commit() -> str | None:
    """Commit of the git checkout, followed by `+` if it has uncommitted changes; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def model_path(config: Any, detector: str) -> Path:
    """Return the file of a fitted model in `config.out`, named after the settings' `name` or else the detector."""
    return inside(config.out, f"{config.name or detector}.safetensors")


def write_outputs(config: Any, report: str, figures: tuple[str, str], model: Path | None = None) -> None:
    """Print the report, write it with the settings and the measures to `config.out`, and list the written files."""
    files = {"report.md": report, "config.yaml": config.yaml(), figures[0]: figures[1]}
    print(report)
    for name, text in files.items():
        write_text(inside(config.out, name), text)
    written = [*([] if model is None else [model]), *(config.out / name for name in files)]
    print("written:", *(f"  {path}" for path in written), sep="\n")


def fit_and_write(config: FitOnLooksConfig, fit: Callable[[Any, Looking], Fit[Any]]) -> None:
    """Look from every cell, fit, and write the model, the report, the settings and the measures."""
    run = Looking(config)
    finish(run, "looking")
    fitted = fit(config, run)
    path = model_path(config, run.eye.detector.name)
    fitted.model.save(path)
    write_outputs(config, fitted.report, ("judged.json", json.dumps(fitted.judged, indent=2) + "\n"), path)
