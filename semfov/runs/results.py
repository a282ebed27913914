"""Outcomes of the scenes of a run, in a database to which each scene is appended, and which is read scene by scene."""

import hashlib
import json
import math
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import Any

from semfov.errors import DataError
from semfov.io.files import check_regular
from semfov.io.schema import is_number

ResultRecord = dict[str, Any]  # the stored outcome of an episode, made of JSON values

_TABLE = """
CREATE TABLE IF NOT EXISTS scenes (
    number INTEGER PRIMARY KEY, sha256 TEXT NOT NULL, seconds TEXT NOT NULL, records TEXT NOT NULL
)
"""
_TOGETHER = 1.0  # seconds after which finished scenes are written: each write waits for the disk
_WAIT = 60.0  # seconds for which another process may write

_DAMAGED = (sqlite3.DatabaseError, UnicodeDecodeError)
"""Errors of a file that is no database, or whose names of columns are none."""


class SceneResults:
    """Outcomes of finished scenes in a SQLite database; damaged rows and those of changed scenes count as missing.

    `_waiting` holds the rows that are not written yet: each write waits for the disk, so that those of a second are
    written together. Everything that reads writes them first.

    Args:
        folder: folder of the database.
        key: digest of everything that outcomes depend on beside the scenes.
        digest: digest of a scene by its number.
    """

    def __init__(self, folder: Path, key: str, digest: Callable[[int], str]) -> None:
        self.path = folder / f"{key}.sqlite"
        self.key = key
        self.digest = digest
        self._waiting: list[tuple[int, str, str, str]] = []
        self._flushed = -math.inf

    def __len__(self) -> int:
        """Count the rows."""
        return int(next(self._rows("SELECT COUNT(*) FROM scenes"), (0,))[0])

    def finished(self, scenes: int) -> set[int]:
        """Numbers of the finished scenes, whose outcomes are verified but not made."""
        return {row[0] for row in self._rows("SELECT * FROM scenes WHERE number < ?", scenes) if self._whole(*row)}

    def items(self, scenes: int) -> Iterator[tuple[int, ResultRecord]]:
        """Yield the numbers and outcomes of finished scenes in their order, one at a time."""
        for row in self._rows("SELECT * FROM scenes WHERE number < ? ORDER BY number", scenes):
            result = self._read(*row)
            if result is not None:
                yield row[0], result

    def read(self, scenes: int) -> Iterator[ResultRecord]:
        """Yield the outcomes of all scenes in their order, one at a time."""
        expected = 0
        for number, result in self.items(scenes):
            if number != expected:
                break
            yield result
            expected += 1
        if expected < scenes:
            raise DataError(f"{self.path}: scene {expected} is missing or damaged; run the same command again")

    def save(self, index: int, records: list[ResultRecord], seconds: dict[str, float]) -> None:
        """Append the outcomes of a scene, or replace them; those of a second are written together.

        Args:
            index: number of the scene.
            records: outcomes of its episodes, as JSON values.
            seconds: how long the parts of the work took.
        """
        seconds_text = json.dumps(seconds)
        records_text = json.dumps(records)
        self._waiting.append((index, self._sha256(index, seconds_text, records_text), seconds_text, records_text))
        if time.monotonic() >= self._flushed + _TOGETHER:
            self.flush()

    def flush(self) -> None:
        """Write the outcomes that are not written yet."""
        if not self._waiting:
            return
        try:
            self._write()
        except (sqlite3.OperationalError, OSError) as error:
            raise DataError(f"cannot write {self.path}: {error}") from error
        except _DAMAGED:
            self.path.unlink()  # it is no database, or damaged: its scenes are run again
            self._write()
        self._waiting.clear()
        self._flushed = time.monotonic()

    def _write(self) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with closing(sqlite3.connect(self.path, timeout=_WAIT)) as database, database:
            database.execute(_TABLE)
            # A damaged row counts as missing: its scene is run again, and takes its place.
            database.executemany("INSERT OR REPLACE INTO scenes VALUES (?, ?, ?, ?)", self._waiting)

    def _rows(self, query: str, *given: int) -> Iterator[tuple[Any, ...]]:
        """Yield the rows of a query, as far as the database is whole."""
        self.flush()
        check_regular(self.path)
        if not self.path.exists():
            return
        # Not read-only: what a process that was killed has half written must be undone first.
        with suppress(*_DAMAGED), closing(sqlite3.connect(self.path, timeout=_WAIT)) as database:
            # A damaged text is read with other letters, and is not that of its sum.
            database.text_factory = partial(str, encoding="utf-8", errors="replace")
            yield from database.execute(query, given)

    def _whole(self, index: int, sha256: str, seconds: str, records: str) -> bool:
        """Whether a row is as it was written, for the same scene."""
        try:
            return sha256 == self._sha256(index, seconds, records)
        except Exception:  # whatever is wrong with the row, the scene can be run again
            return False

    def _read(self, index: int, sha256: str, seconds: str, records: str) -> ResultRecord | None:
        """Read the outcomes of a row; None if it is damaged, or of a scene that has changed."""
        if not self._whole(index, sha256, seconds, records):
            return None
        try:
            outcomes = json.loads(records)
            times = json.loads(seconds)
        except (ValueError, RecursionError):
            return None
        # The sum tells that the texts are those of this row, and not that they are of this form.
        are_outcomes = isinstance(outcomes, list) and all(isinstance(outcome, dict) for outcome in outcomes)
        are_times = isinstance(times, dict) and all(map(is_number, times.values()))
        return {"records": outcomes, "seconds": times} if are_outcomes and are_times else None

    def _sha256(self, index: int, seconds: str, records: str) -> str:
        # With what the outcomes depend on: a row of another scene or run is none of this one.
        head = json.dumps([self.key, index, self.digest(index), seconds])
        return hashlib.sha256(f"{head}\n{records}".encode()).hexdigest()
