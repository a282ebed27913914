"""The base of runs over many scenes, which several processes share and which continue after an interruption."""

import hashlib
import json
import logging
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import closing
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from semfov.data.scene import Scenes
from semfov.io.code import class_digest, package_digest
from semfov.io.files import cache_folder
from semfov.io.pretrained import Pretrained
from semfov.runs.results import ResultRecord, SceneResults
from semfov.runs.store import versions
from semfov.runs.workers import run_tasks

_log = logging.getLogger(__name__)


class SceneRun(ABC):
    """Base of runs over many scenes, one after the other; any process can build the run from its settings."""

    config: Any
    scenes: Scenes

    @cached_property
    def code(self) -> str:
        """Digest of the whole package, of the versions of the libraries that it uses, and of the run's own code."""
        return digest_of([package_digest(), versions(), class_digest(type(self))])

    @cached_property
    def key(self) -> str:
        """Short key of settings, models and scenes, and of the code; it keeps the outcomes of different runs apart."""
        depends_on = digest_of({"scenes": self.scenes.fingerprint, **self.depends_on()})
        return f"{depends_on[:16]}-{self.code[:16]}"

    @abstractmethod
    def depends_on(self) -> dict[str, object]:
        """List the fitted models and the settings that the outcomes depend on, beside scenes and code."""

    @property
    def results(self) -> SceneResults:
        """The outcomes of finished scenes."""
        return SceneResults(self.config.out / "parts", self.key, self.digest)

    @cached_property
    def digest(self) -> Callable[[int], str]:
        """Gives the sha256 of what the pixels of a scene depend on, by its number."""
        return cache(self.scenes.digest)

    @abstractmethod
    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run the episodes of a scene; returns their records, and the seconds that each stage took."""

    def stored(self, index: int) -> bytes | None:
        """Return the file that a worker stored for a scene, if the run needs it later; None without such a file."""
        return None

    def keep(self, index: int, stored: bytes) -> None:
        """Store the content of a file that a worker stored for a scene, if this process does not see that file."""
        raise NotImplementedError(f"{type(self).__name__} stores nothing of a scene")


def store_folder(chosen: Path | None) -> Path:
    """Return the folder of the stores: the chosen one, or the user's cache."""
    return cache_folder() if chosen is None else chosen


def finish(run: SceneRun, title: str) -> None:
    """Run the scenes that are not finished yet, on the processors of the settings, and store their outcomes.

    Args:
        run: the run.
        title: title of the progress bar.
    """
    results = run.results
    finished = results.finished(len(run.scenes))
    remaining = [index for index in range(len(run.scenes)) if index not in finished]
    if remaining:
        _warn_of_older_results(run, results)
    done = run_tasks(
        _outcomes_of,
        remaining,
        where=run.config.where,
        make=type(run),
        settings=(run.config,),
        title=title,
        unit="scene",
    )
    try:
        with closing(done):
            for index, (records, seconds, stored) in done:
                if stored is not None:
                    run.keep(index, stored)
                results.save(index, records, seconds)
    finally:
        results.flush()


def _warn_of_older_results(run: SceneRun, results: SceneResults) -> None:
    """Warn where another version of the code finished scenes with the same settings, models and scenes."""
    settings, _, _ = results.key.partition("-")
    counts = [
        len(SceneResults(path.parent, path.stem, run.digest))
        for path in results.path.parent.glob(f"{settings}-*.sqlite")
        if path != results.path
    ]
    older = max(counts, default=0)
    if older:
        _log.warning(
            "%s: %d scenes were finished with these settings by another version of the code (semfov or a library has "
            "changed since); they are computed anew",
            run.config.out,
            older,
        )


def digest_of(what: object) -> str:
    """Compute the sha256 of a JSON value, in which fitted models count by their digests."""
    return hashlib.sha256(json.dumps(what, sort_keys=True, default=Pretrained.digest).encode()).hexdigest()


def _outcomes_of(run: SceneRun, index: int) -> tuple[list[ResultRecord], dict[str, float], bytes | None]:
    """Run all episodes of a scene; returns their records, the seconds of each stage, and what was stored."""
    return *run.outcomes(index), run.stored(index)
