"""Outcomes of finished scenes on disk, so that a killed run goes on where it was."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from semfov.io.files import check_regular, write_text
from semfov.io.schema import is_number

Record = dict[str, Any]
"""What is kept of an episode, as JSON values."""


class Parts:
    """Outcomes of finished scenes, one file each.

    Args:
        folder: that they lie in; those of another run have another folder in it.
        key: of the run: of its settings and of its code, with a dash between.
        digest: sha256 of a scene's image, by its number.
    """

    def __init__(self, folder: Path, key: str, digest: Callable[[int], str]) -> None:
        self.folder = folder / key
        self.key = key
        self.digest = digest

    def path(self, index: int) -> Path:
        """File of a scene."""
        return self.folder / f"{index:06d}.json"

    def load(self, index: int) -> dict[str, Any] | None:
        """Outcomes of a scene, or None if they are not there whole."""
        path = self.path(index)
        try:
            check_regular(path)
            part = json.loads(path.read_text(encoding="utf-8"))
            records, seconds = part["records"], part["seconds"]
            whole = part["key"] == self.key and part["sha256"] == self._sha256(index, records, seconds)
            formed = isinstance(records, list) and all(isinstance(record, dict) for record in records)
            formed = formed and isinstance(seconds, dict) and all(map(is_number, seconds.values()))
        except Exception:  # whatever is wrong with it, it can be made again
            return None
        return part if whole and formed else None

    def save(self, index: int, records: list[Record], seconds: dict[str, float]) -> None:
        """Keep the outcomes of a scene."""
        verified = {"key": self.key, "sha256": self._sha256(index, records, seconds)}
        write_text(self.path(index), json.dumps({**verified, "records": records, "seconds": seconds}))

    def by_other_code(self) -> int:
        """How many scenes were finished with the same settings by code that has changed since."""
        settings = self.key.partition("-")[0]
        folders = self.folder.parent.glob(f"{settings}-*")
        return max((len(list(folder.glob("*.json"))) for folder in folders if folder != self.folder), default=0)

    def _sha256(self, index: int, records: object, seconds: object) -> str:
        return hashlib.sha256(json.dumps([index, self.digest(index), records, seconds]).encode()).hexdigest()
