"""Records of all scenes of a run, in their order."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from typing import Any

from semfov.runs.config import WHERE
from semfov.runs.results import ResultRecord, SceneResults
from semfov.runs.scene_run import SceneRun
from semfov.runs.settings import Settings


class StoredRecords:
    """Records of all scenes in their order, read from the database whenever they are iterated over.

    One scene is held at a time, so that memory does not grow with their number.
    """

    def __init__(self, results: SceneResults, scenes: int) -> None:
        self._results = results
        self._scenes = scenes
        self._seconds: dict[str, float] | None = None

    def __iter__(self) -> Iterator[ResultRecord]:
        """Read the records."""
        seconds: dict[str, float] = defaultdict(float)
        for result in self._results.read(self._scenes):
            yield from result["records"]
            for stage, value in result["seconds"].items():
                seconds[stage] += value
        self._seconds = dict(seconds)

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds that each stage took in all scenes."""
        if self._seconds is None:
            deque(self, maxlen=0)
        assert self._seconds is not None
        return self._seconds


def gather(run: SceneRun) -> StoredRecords:
    """Read records of all scenes in their order, as they are asked for, and the seconds that each stage took."""
    return StoredRecords(run.results, len(run.scenes))


def own_settings(config: Settings, *others: str) -> dict[str, Any]:
    """List the settings without those that the eye and scenes tell, that change no outcome, or that are `others`."""
    left_out = (*WHERE, "store", "data", "detector", *others)
    return {name: value for name, value in config.plain().items() if name not in left_out}


def grouped(records: Iterable[ResultRecord], field: str) -> dict[str, list[ResultRecord]]:
    """Group records by a field, such as the way that a search was made; groups and records keep their order.

    Args:
        records: the records.
        field: name of the field.

    Returns:
        The records of each value.
    """
    groups: dict[str, list[ResultRecord]] = {}
    for record in records:
        groups.setdefault(record[field], []).append(record)
    return groups
