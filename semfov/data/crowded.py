"""A subset of a set of scenes: those with the most objects."""

import hashlib
import json
import math

from semfov.data.scene import Annotation, Scene, Scenes
from semfov.errors import check


class Crowded:
    """The given share of a set's scenes, those with the most objects; among equals the first scenes count.

    Args:
        scenes: the set.
        share: share of its scenes, above 0 and at most 1; rounded up.

    Raises:
        InputError: the share is outside its range, or the set is empty.

    >>> from semfov.data import EmbeddedScenes
    >>> scenes = EmbeddedScenes(("person", "cat"), count=6)
    >>> crowded = Crowded(scenes, 1 / 3)
    >>> len(crowded), set(crowded.ids) <= set(scenes.ids)
    (2, True)
    """

    def __init__(self, scenes: Scenes, share: float) -> None:
        check(0 < share <= 1, "share", "above 0 and at most 1", share)
        check(len(scenes) > 0, "scenes", "at least one scene", len(scenes))
        counts = [len(scenes.annotation(index).boxes) for index in range(len(scenes))]
        order = sorted(range(len(scenes)), key=lambda index: -counts[index])
        self._scenes, self._chosen = scenes, sorted(order[: math.ceil(share * len(scenes))])
        self.classes = scenes.classes
        every = scenes.ids
        self.ids: list[int] | list[str] = [every[index] for index in self._chosen]  # type: ignore[assignment]
        self.fingerprint = hashlib.sha256(json.dumps([scenes.fingerprint, self.ids]).encode()).hexdigest()

    def __len__(self) -> int:
        return len(self._chosen)

    def __getitem__(self, index: int) -> Scene:
        """Decode a scene."""
        return self._scenes[self._chosen[index]]

    def annotation(self, index: int) -> Annotation:
        """Return the objects of a scene, without decoding its image."""
        return self._scenes.annotation(self._chosen[index])

    def targets(self, index: int) -> list[int]:
        """List the classes of a scene that may be searched for."""
        return self._scenes.targets(self._chosen[index])

    def digest(self, index: int) -> str:
        """Compute a sha256 of everything that the pixels of a scene depend on."""
        return self._scenes.digest(self._chosen[index])
