"""Outcomes of finished scenes on disk, so that a killed run goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semfov.io.files import write_text

Record = dict[str, Any]
"""What is kept of an episode, as JSON values."""


class Parts:
    """Outcomes of finished scenes, one file each.

    Args:
        folder: that they lie in; those of another run have another folder in it.
        key: of the run, sha256 of everything that the outcomes depend on.
    """

    def __init__(self, folder: Path, key: str) -> None:
        self.folder = folder / key[:16]
        self.key = key

    def path(self, index: int) -> Path:
        """File of a scene."""
        return self.folder / f"{index:06d}.json"

    def load(self, index: int) -> dict[str, Any] | None:
        """Outcomes of a scene, or None if they are not there whole."""
        try:
            part = json.loads(self.path(index).read_text(encoding="utf-8"))
            whole = part["key"] == self.key and part["sha256"] == _digest(index, part["records"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return part if whole else None

    def save(self, index: int, records: list[Record], seconds: dict[str, float]) -> None:
        """Keep the outcomes of a scene."""
        part = {"key": self.key, "sha256": _digest(index, records), "records": records, "seconds": seconds}
        write_text(self.path(index), json.dumps(part))


def _digest(index: int, records: Sequence[object]) -> str:
    return hashlib.sha256(json.dumps([index, records]).encode()).hexdigest()
