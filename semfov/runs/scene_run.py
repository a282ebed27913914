"""The base of runs over many scenes, which several processes share and which continue after an interruption."""

from __future__ import annotations

import hashlib
import json
import logging
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable
from contextlib import closing
from functools import cached_property
from pathlib import Path
from typing import Any

from semfov.data.scene import Scenes
from semfov.errors import DataError
from semfov.io.code import class_digest, package_digest
from semfov.io.files import check_regular, write_text
from semfov.io.pretrained import Pretrained
from semfov.io.schema import is_number
from semfov.runs.config import WHERE
from semfov.runs.setup import prepare_worker
from semfov.runs.store import versions
from semfov.runs.workers import run_tasks

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

    def _sha256(self, index: int, records: object, seconds: object) -> str:
        return hashlib.sha256(json.dumps([index, self.digest(index), records, seconds]).encode()).hexdigest()


_log = logging.getLogger(__name__)

_BESIDES = (*WHERE, "store", "data", "detector")


class SceneRun(ABC):
    """Base of runs over many scenes, one after the other; any process can build the run from its settings."""

    config: Any
    scenes: Scenes

    @cached_property
    def settings_key(self) -> str:
        """sha256 of all settings, models and scenes that the outcomes depend on."""
        return digest_of({"scenes": self.scenes.fingerprint, **self.depends_on()})

    @cached_property
    def code(self) -> str:
        """Digest of the whole package, of the versions of the libraries that it uses, and of the run's own code."""
        return digest_of([package_digest(), versions(), class_digest(type(self))])

    @property
    def key(self) -> str:
        """Short key of settings and code; it keeps the outcomes of different runs apart."""
        return f"{self.settings_key[:16]}-{self.code[:16]}"

    @abstractmethod
    def depends_on(self) -> dict[str, Any]:
        """List the fitted models and the settings that the outcomes depend on, beside scenes and code."""

    def own_settings(self, *others: str) -> dict[str, Any]:
        """The settings without those that the eye and the scenes tell, that change no outcome, or that are `others`."""
        return {name: value for name, value in self.config.plain().items() if name not in (*_BESIDES, *others)}

    @property
    def results(self) -> SceneResults:
        """The outcomes of finished scenes."""
        return SceneResults(self.config.out / "parts", self.key, self.digest)

    def digest(self, index: int) -> str:
        """sha256 of what the pixels of a scene depend on."""
        return self.scenes.digest(index)

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run the episodes of a scene; returns their records, and the seconds that each stage took."""

    def stored(self, index: int) -> bytes | None:
        """Content of the file that a worker stored for a scene, if the run needs it later; None without such a file."""
        return None

    def keep(self, index: int, stored: bytes) -> None:
        """Store the content of a file that a worker stored for a scene, if this process does not see that file."""
        raise NotImplementedError(f"{type(self).__name__} stores nothing of a scene")


def store_folder(chosen: Path | None) -> Path:
    """Folder of the stores: the chosen one, or the user's cache."""
    if chosen is not None:
        return chosen
    from semfov.detection.weights import cache_folder as user_cache

    return user_cache()


def finish(run: SceneRun, title: str) -> None:
    """Run the scenes that are not finished yet, and store their outcomes."""
    results = run.results
    todo = [index for index in range(len(run.scenes)) if results.load(index) is None]
    others = results.folder.parent.glob(f"{results.key.partition('-')[0]}-*")
    older = max((len(list(folder.glob("*.json"))) for folder in others if folder != results.folder), default=0)
    if todo and older:
        _log.warning(
            "%s: %d scenes were finished with these settings by another version of the code (semfov or a library has "
            "changed since); they are computed anew",
            run.config.out,
            older,
        )
    done = run_tasks(
        _outcomes_of,
        todo,
        where=run.config.where,
        setup=_prepare_process,
        settings=(type(run), run.config),
        title=title,
        unit="scene",
    )
    with closing(done):
        for index, (records, seconds, stored) in done:
            if stored is not None:
                run.keep(index, stored)
            results.save(index, records, seconds)


def gather(run: SceneRun) -> tuple[list[ResultRecord], dict[str, float]]:
    """Records of all scenes in their order, and the seconds that each stage took."""
    records: list[ResultRecord] = []
    seconds: dict[str, float] = defaultdict(float)
    for index in range(len(run.scenes)):
        result = run.results.load(index)
        if result is None:
            raise DataError(f"{run.results.path(index)} is missing or damaged; run the same command again")
        records += result["records"]
        for stage, value in result["seconds"].items():
            seconds[stage] += value
    return records, dict(seconds)


def digest_of(what: object) -> str:
    """The sha256 of a JSON value, in which fitted models count by their digests."""
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=Pretrained.digest).encode()).hexdigest()


_process: dict[str, SceneRun] = {}


def _prepare_process(make: Callable[[Any], SceneRun], config: Any) -> None:
    """Build the run in this process, once."""
    prepare_worker()
    _process["run"] = make(config)


def _outcomes_of(index: int) -> tuple[list[ResultRecord], dict[str, float], bytes | None]:
    """Run all episodes of a scene; returns their records, the seconds of each stage, and what was stored."""
    run = _process["run"]
    return *run.outcomes(index), run.stored(index)
