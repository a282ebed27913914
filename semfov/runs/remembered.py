"""A cache of looks at one scene, in memory and, with a store, on disk: each look is made only once."""

from collections.abc import Callable
from typing import Generic

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.eye import Eye
from semfov.runs.looks import one_thread, photograph_looks
from semfov.runs.store import Action, DetectionStore, LookStore, StoredLook


class RememberedLooks(Generic[Action, StoredLook]):
    """Looks at one scene by action, each made once: read from a store, or computed when it is first asked for.

    Looks pass through the detector one at a time and on one thread. The bits then depend neither on which looks share a
    batch nor on the number of CPU cores.

    Args:
        open_scene: opens the scene; returns the function that looks. It is called only when a look is missing.
        store: store of the looks; None keeps them in memory.
        digest: gives the sha256 of what the pixels of the scene depend on; called only with a store.
    """

    def __init__(
        self,
        open_scene: Callable[[], Callable[[Action], StoredLook]],
        store: LookStore[Action, StoredLook] | None = None,
        digest: Callable[[], str] = lambda: "",
    ) -> None:
        self._open, self._store, self._digest = open_scene, store, digest
        self._look: Callable[[Action], StoredLook] | None = None
        self._looks: dict[Action, StoredLook] | None = None
        self._stored = 0

    @property
    def looks(self) -> dict[Action, StoredLook]:
        """All looks so far, by action."""
        if self._looks is None:
            self._looks = {} if self._store is None else self._store.load(self._digest())
            self._stored = len(self._looks)
        return self._looks

    def __call__(self, action: Action) -> StoredLook:
        """Look, or remember."""
        looks = self.looks
        if action not in looks:
            with one_thread(), torch.inference_mode():
                self._look = self._open() if self._look is None else self._look
                looks[action] = self._look(action)
        return looks[action]

    def save(self) -> None:
        """Store the looks at the scene if there are new ones."""
        if self._store is not None and self._looks is not None and len(self._looks) > self._stored:
            self._store.save(self._digest(), self._looks)
            self._stored = len(self._looks)

    def close(self) -> None:
        """Store new looks, and free the opened scene and the stored looks; a later look reads them again."""
        self._look = None
        self.save()
        if self._store is not None:
            self._looks = None


def look_everywhere(
    eye: Eye, image: Callable[[], Tensor], grid: Grid, store: DetectionStore | None, digest: Callable[[], str]
) -> Detections:
    """Detections from the centre of every cell of a photograph, read from a store, or computed and stored.

    Args:
        eye: sensor and detector.
        image: gives the image, `(1, 3, H, W)`.
        grid: the cells.
        store: store of the looks; None stores none.
        digest: gives the sha256 of what the pixels depend on.

    Returns:
        The detections, a batch of X·Y.
    """
    looks = RememberedLooks(lambda: photograph_looks(eye, image, grid), store, digest)
    detections = Detections.stack([looks(cell) for cell in range(len(grid))])
    looks.save()
    return detections
