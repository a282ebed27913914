"""The kinds of look of an agent: how each opens a picture, and the episode that it runs for each task.

A new kind has its name, words and drawings in `semfov.kinds`, a class here, and the part of the agent that makes its
episodes (`AgentParts`, `semfov.agent`). Its record is a subclass of `semfov.paths.Record`, which names the kind and has
words, a format of its file and data for pages; one that is like a record of another kind is a subclass of that.
`OpenedPicture.kind` chooses it for `auto`, and `semfov.settings` says which settings mean something to it.
"""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import ClassVar, Protocol

from semfov.agents.episode import StreamEpisode
from semfov.agents.fovea import FoveaAgent
from semfov.agents.head import HeadAgent
from semfov.agents.picture import OpenedPicture
from semfov.agents.windows import ZoomAgent
from semfov.belief.observers.any_of import TargetLike
from semfov.errors import InputError, check
from semfov.kinds import FOVEA, HEAD, WINDOWS, LookKind
from semfov.paths import Moment, Record
from semfov.settings import (
    ExploreSettings,
    FindSettings,
    SearchSettings,
    StreamSettings,
)
from semfov.strategy import classes_named


class AgentParts(Protocol):
    """The parts of an agent, one for each kind of look; a part that the agent cannot have raises `InputError`."""

    @property
    def fovea(self) -> FoveaAgent: ...

    @property
    def zoom(self) -> ZoomAgent: ...

    @property
    def head(self) -> HeadAgent: ...


class KindOfLook(ABC):
    """A kind of look of an agent: it opens a picture in its own form, and runs the episode of each task.

    A subclass is registered under the name of its `kind` by being defined (`KINDS_OF_LOOK`).

    Attributes:
        kind: what is known of the kind without an agent.
    """

    kind: ClassVar[LookKind]

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        KINDS_OF_LOOK[cls.kind.name] = cls

    def __init__(self, parts: AgentParts) -> None:
        self.parts = parts

    @abstractmethod
    def search(self, picture: OpenedPicture, target: TargetLike, settings: SearchSettings) -> Record:
        """Search a picture for a target (`ActivePerception.search`)."""

    @abstractmethod
    def find_all(self, picture: OpenedPicture, targets: tuple[int, ...], settings: FindSettings) -> Record:
        """Find all objects of the given classes (of every class if none is given; `ActivePerception.find_all`)."""

    @abstractmethod
    def explore(self, picture: OpenedPicture, settings: ExploreSettings) -> Record:
        """Explore a picture (`ActivePerception.explore`)."""

    def stream(self, target: int | None, targets: tuple[int, ...], settings: StreamSettings) -> StreamEpisode[Moment]:
        """Make the episode that looks at the frames of a stream (`ActivePerception.live`).

        Args:
            target: class 1..K to search for; None explores.
            targets: classes 1..K whose objects are all to be found; empty for `target`.
            settings: the settings of the task.

        Returns:
            The episode, to which frames are given.

        Raises:
            InputError: the kind takes no stream, or the settings do not suit the agent.
        """
        raise InputError(
            "how: expected 'fovea', 'windows' or 'auto' for a stream; for a camera that turns use search, and for a "
            f"panoramic frame search or find_all of semfov.Panorama(frame), got {self.kind.name}"
        )


KINDS_OF_LOOK: dict[str, type[KindOfLook]] = {}
"""The kinds of look by name."""


class FoveaKind(KindOfLook):
    """Looks of a fovea that moves over the cells of a photograph."""

    kind = FOVEA

    def search(self, picture: OpenedPicture, target: TargetLike, settings: SearchSettings) -> Record:
        fovea = self.parts.fovea
        return picture.named(fovea.search(picture.pixels(fovea.eye.sensor.like), target, settings))

    def find_all(self, picture: OpenedPicture, targets: tuple[int, ...], settings: FindSettings) -> Record:
        fovea = self.parts.fovea
        record = fovea.find_all(picture.pixels(fovea.eye.sensor.like), targets, settings)
        return _counted_from(picture.named(record), settings.score_threshold)

    def explore(self, picture: OpenedPicture, settings: ExploreSettings) -> Record:
        fovea = self.parts.fovea
        # Where people look is predicted from floats.
        read = picture.pixels if settings.policy is None else picture.image
        record = fovea.explore(read(fovea.eye.sensor.like), settings)
        return _counted_from(picture.named(record), settings.score_threshold)

    def stream(self, target: int | None, targets: tuple[int, ...], settings: StreamSettings) -> StreamEpisode[Moment]:
        expected = "one class by its name, or None, for a fovea, or how='windows', which finds all objects of a list"
        check(not targets, "target", expected, "a list")
        return self.parts.fovea.stream(target, settings)


class WindowKind(KindOfLook):
    """Looks at windows of a picture of any size, the first of them the whole picture."""

    kind = WINDOWS

    def search(self, picture: OpenedPicture, target: TargetLike, settings: SearchSettings) -> Record:
        return self.parts.zoom.search(picture.large, _one_class(target), settings)

    def find_all(self, picture: OpenedPicture, targets: tuple[int, ...], settings: FindSettings) -> Record:
        return self.parts.zoom.find_all(picture.large, targets or None, settings)

    def explore(self, picture: OpenedPicture, settings: ExploreSettings) -> Record:
        return self.parts.zoom.explore(picture.large, settings)

    def stream(self, target: int | None, targets: tuple[int, ...], settings: StreamSettings) -> StreamEpisode[Moment]:
        return self.parts.zoom.stream(target, targets, settings)


class HeadKind(KindOfLook):
    """Looks of an eye in a head that turns to parts of a scene."""

    kind = HEAD

    def search(self, picture: OpenedPicture, target: TargetLike, settings: SearchSettings) -> Record:
        return self.parts.head.search(picture.world, _one_class(target), settings)

    def find_all(self, picture: OpenedPicture, targets: tuple[int, ...], settings: FindSettings) -> Record:
        return self.parts.head.find_all(picture.world, targets or None, settings)

    def explore(self, picture: OpenedPicture, settings: ExploreSettings) -> Record:
        return self.parts.head.explore(picture.world, settings)


def _counted_from(record: Record, score_threshold: float | None) -> Record:
    """Count the objects of a record from a probability or score on; None leaves the record as it is."""
    return record if score_threshold is None else replace(record, score_threshold=score_threshold)


def _one_class(target: TargetLike) -> str | int:
    """Take the class that is searched for where only one can be."""
    classes = classes_named(target)
    check(len(classes) == 1, "target", "one class for a search by windows or a head; find_all takes several", target)
    return classes[0]
