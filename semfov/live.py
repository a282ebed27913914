"""Active perception of a camera or a video: one look at every frame; old looks count less with time."""

import sys
from typing import NoReturn

from numpy.typing import ArrayLike

from semfov.agents.kinds import KINDS_OF_LOOK, AgentParts
from semfov.agents.picture import OpenedPicture
from semfov.attribute_words import LIVE, OtherWords, Room
from semfov.data.inputs import FRAME, ImageLike, as_image
from semfov.data.tone import White, check_white
from semfov.errors import InputError, check, checked_keywords
from semfov.motion import Motion
from semfov.paths import Moment
from semfov.settings import How, StreamSettings

__all__ = ["LivePerception"]


class LivePerception(OtherWords):
    """Looks at the frames of a stream, with one pass of the detector at each, through windows or a fovea.

    With `how="auto"` it looks through windows. It uses a fovea if frames are less than four times as long as the
    detector's input and either the agent has no evidence for photographs or a first cell is given.

    With windows, objects keep their places when the camera moves. If a frame fits none before it, as after a cut or in
    the dark, earlier objects are set aside, and only those seen from that frame on are listed. The moment is `lost`
    until the scene is found again or, after twelve frames, given up. The scene is assumed to be flat or far away. A
    fovea does not follow the camera.

    Args:
        parts: the agent, which has a part for each kind of look.
        target: class 1..K to search for; None explores.
        targets: classes 1..K of which to find all objects, with windows; empty to use `target`.
        settings: the settings of the task; None for the defaults.
        white: the values that are black and white in frames of other types than bytes (`ActivePerception.search`).

    Attributes:
        how: the kind of look; `auto` before the first frame.

    Raises:
        InputError: an argument does not fit the kind of look.

    Example::

        live = ActivePerception.recommended().live("cup")
        for frame in frames:
            moment = live.step(frame)
            print(moment.describe())
    """

    _other_words = LIVE

    def __init__(
        self,
        parts: AgentParts,
        target: int | None = None,
        targets: tuple[int, ...] = (),
        settings: StreamSettings | None = None,
        *,
        white: White | None = None,
    ) -> None:
        settings = settings or StreamSettings()
        is_known = settings.prior is None or target is not None
        check(is_known, "prior", "None without one class to search for", settings.prior)
        check_white(white)
        self.how: How = "windows" if targets and settings.how == "auto" else settings.how
        self._white = white
        self._start = settings.start
        windows = parts.zoom
        self._canvas = windows.eye.detector.input_size
        self._photographs = windows.suits_photographs and settings.start is None
        # A kind of look that no frame can ask for is not made: it may refuse settings that suit the other.
        self._episodes = {}
        for name in self._possible_kinds():
            self._episodes[name] = KINDS_OF_LOOK[name](parts).stream(target, targets, settings)
        self._check_start()

    def _possible_kinds(self) -> tuple[str, ...]:
        """List the kinds of look that the first frame may ask for."""
        if self.how != "auto":
            return (self.how,)
        return ("windows",) if self._photographs else ("fovea", "windows")

    def __call__(self, *arguments: object, **options: object) -> NoReturn:
        """Refuse a call of the stream itself with the name of its method.

        Args:
            *arguments: any.
            **options: any.

        Raises:
            InputError: always.
        """
        raise InputError("a stream is not called itself: live.step(frame) takes its frames")

    @checked_keywords
    def step(self, frame: ImageLike, passed: float = FRAME, pose: Motion | ArrayLike | None = None) -> Moment:
        """Look at the next frame.

        Args:
            frame: a picture of any common kind (`semfov.as_image`), of the same size as the first frame.
            passed: seconds since the last frame, for which evidence fades, such as the difference of two time stamps;
                1/25 s if it is not given.
            pose: the map from pixels of the first frame to pixels of this one, if the camera's motion is known from a
                gimbal or odometry: a `semfov.motion.Motion`, or its `(3, 3)` or `(2, 3)` matrix. Give it for all frames
                or none. None: the motion is estimated from the frames (`semfov.motion.CameraMotion`).

        Returns:
            What is known at this frame: a `FoveaMoment` or a `WindowMoment`.

        Raises:
            InputError: the frame is no picture or has another size, or an argument does not fit the kind of look.
            DataError: the file of the frame cannot be read.
        """
        got = "None (OpenCV gives None after the last frame, and where it cannot read one)"
        check(frame is not None, "frame", "a picture", got)
        # Episodes take frames whose white is that of their type.
        if self._white is not None:
            frame = as_image(frame, argument="frame", white=self._white)
        picture = OpenedPicture.of(frame)
        check(not picture.scene, "frame", "a picture; search and find_all take scenes", type(frame).__name__)
        if self.how == "auto":
            self.how = picture.kind("auto", self._canvas, photographs=self._photographs)
            self._check_start()
        return self._episodes[self.how].step(frame, passed, pose)

    @property
    def criterion(self) -> str | None:
        """What the decision `found` requires, in words; None before the first frame, and without decisions."""
        return None if self.how == "auto" else self._episodes[self.how].criterion

    def describe(self) -> str:
        """Describe the task in a few words."""
        return next(iter(self._episodes.values())).describe()

    def __repr__(self) -> str:
        """Write what is done, and the kind of look."""
        return f"{type(self).__name__}: {self.describe()}, how={self.how!r}"

    def _check_start(self) -> None:
        """Raise `InputError` for a first cell where there are no cells."""
        check(
            self._start is None or self.how != "windows",
            "start",
            "None for frames that are looked at by windows, or how='fovea'",
            self._start,
        )


sys.modules[__name__].__class__ = Room
