"""What fits write: the model, a report, and the settings and measures."""

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from semfov.io.files import inside, write_text


class OutputSettings(Protocol):
    """Settings of a fit that writes to a folder."""

    @property
    def out(self) -> Path:
        """The folder."""

    @property
    def name(self) -> str | None:
        """Name of the model; None: that of the detector."""

    def yaml(self) -> str:
        """Write the settings as a file."""


def commit() -> str | None:
    """Return the commit of the git checkout, followed by `+` if it has uncommitted changes; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def model_path(config: OutputSettings, detector: str) -> Path:
    """Return the file of a fitted model in `config.out`, named after the settings' `name` or else the detector."""
    return inside(config.out, f"{config.name or detector}.safetensors")


def write_outputs(config: OutputSettings, report: str, figures: Mapping[str, str], *others: Path) -> None:
    """Print the report, write it with the settings and the measures to `config.out`, and list the written files.

    Args:
        config: settings of the fit.
        report: the report in Markdown.
        figures: texts of the files of measures, by name.
        others: files that are written already, such as the model.
    """
    files = {"report.md": report, "config.yaml": config.yaml(), **figures}
    print(report)
    for name, text in files.items():
        write_text(inside(config.out, name), text)
    print("written:", *(f"  {path}" for path in (*others, *(config.out / name for name in files))), sep="\n")
