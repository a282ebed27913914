"""Outcomes of finished scenes on disk, so that a killed run continues where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from semfov.io.files import check_regular, write_text
from semfov.io.schema import is_number

ResultRecord = dict[str, Any]
"""The stored outcome of an episode, made of JSON values."""


class SceneResults:
    """Outcomes of finished scenes, one file each."""

    def __init__(self, folder: Path, key: str, digest: Callable[[int], str]) -> None:
        self.folder = folder / key
        self.key = key
        self.digest = digest

    def path(self, index: int) -> Path:
        """Path of a scene's file."""
        return self.folder / f"{index:06d}.json"

    def load(self, index: int) -> dict[str, Any] | None:
        """The outcomes of a scene; None if they are missing or damaged."""
        path = self.path(index)
        try:
            check_regular(path)
            result = json.loads(path.read_text(encoding="utf-8"))
            records, seconds = result["records"], result["seconds"]
            whole = result["key"] == self.key and result["sha256"] == self._sha256(index, records, seconds)
            formed = isinstance(records, list) and all(isinstance(record, dict) for record in records)
            formed = formed and isinstance(seconds, dict) and all(map(is_number, seconds.values()))
        except Exception:  # whatever is wrong with the file, the scene can be run again
            return None
        return result if whole and formed else None

    def save(self, index: int, records: list[ResultRecord], seconds: dict[str, float]) -> None:
        """Store the outcomes of a scene."""
        verified = {"key": self.key, "sha256": self._sha256(index, records, seconds)}
        write_text(self.path(index), json.dumps({**verified, "records": records, "seconds": seconds}))

    def by_other_code(self) -> int:
        """Number of scenes that were finished with the same settings by another version of the code."""
        settings = self.key.partition("-")[0]
        folders = self.folder.parent.glob(f"{settings}-*")
        return max((len(list(folder.glob("*.json"))) for folder in folders if folder != self.folder), default=0)

    def _sha256(self, index: int, records: object, seconds: object) -> str:
        return hashlib.sha256(json.dumps([index, self.digest(index), records, seconds]).encode()).hexdigest()
