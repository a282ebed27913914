"""Active perception of a camera or a video: one look at every frame, and evidence that fades between frames."""

from typing import Any, get_args

from numpy.typing import ArrayLike

from semfov.agents.episode import Episode, without_none
from semfov.agents.fovea import FoveaAgent, FoveaEpisode
from semfov.agents.picture import OpenedPicture
from semfov.agents.windows import ZoomAgent
from semfov.data.inputs import FRAME, Color, ImageLike, as_image
from semfov.data.tone import White, check_white
from semfov.errors import check, lookup
from semfov.motion import Motion
from semfov.paths import Moment

__all__ = ["LivePerception"]

_FOVEA_RATE = 2.5  # default rate at which the belief of a fovea fades, per second
_WINDOW_RATE = 0.75  # default rate at which looks at windows are forgotten, per second: a look counts for 0.9 s


class LivePerception:
    """Looks at the frames of a stream with one pass of the detector each, by a fovea or at windows.

    With `how="auto"` windows are looked at. A fovea looks at frames that are less than four times as long as the
    detector's input where the agent has no evidence for photographs, or where a first cell is given.

    Looks at windows follow a camera that moves: what they showed is carried along. Where a frame fits none before it,
    after a cut or in the dark, the moment is `lost`, and only what that frame shows is listed, until the scene is found
    again. The scene is taken to be flat or far away. A fovea does not follow the camera.

    Args:
        fovea: the part of an agent that looks by a fovea.
        windows: the part of the agent that looks at windows.
        target: class 1..K to search for; None explores.
        targets: classes 1..K whose objects are all to be found, which windows do; empty for `target`.
        how: the kind of look, `fovea`, `windows` or `auto`.
        rate: rate at which evidence fades, per second; None takes 2.5 for a fovea and 0.75 for windows.
        start: first cell of a fovea; None draws one at random.
        seed: seed of the generator that draws the start and breaks ties.
        white: the values that are black and white in frames of other types than bytes (`ActivePerception.search`).
        **settings: `confirm`, `give_up`, `closer`, `prior` and `color`, as for `ActivePerception.live`.

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

    def __init__(
        self,
        fovea: FoveaAgent,
        windows: ZoomAgent,
        target: int | None = None,
        targets: tuple[int, ...] = (),
        *,
        how: str = "auto",
        rate: float | None = None,
        start: int | None = None,
        seed: int = 0,
        white: White | None = None,
        **settings: Any,
    ) -> None:
        check(how != "head", "how", "'fovea', 'windows' or 'auto' for a stream; for a camera that turns use search, "
              "and for a panoramic frame search or find_all of semfov.Panorama(frame)", how)  # fmt: skip
        several = "for all objects of several classes use how='windows', and for one of them a class without a list"
        check(not targets or how != "fovea", "target", f"one class, or None; {several}", targets)
        self.how = "windows" if targets else how
        check_white(white)
        self._white = white
        self._start, self._canvas = start, windows.eye.detector.input_size
        evidence = windows.evidence
        self._photographs = start is None and evidence is not None and evidence.photograph is not None
        lookup(settings.get("color", "rgb"), get_args(Color), "order of channels")
        given, (slow, fast) = without_none(**settings), (_WINDOW_RATE, _FOVEA_RATE) if rate is None else (rate, rate)
        by_kind = {"fovea": given, "windows": given}
        without_prior = {name: value for name, value in given.items() if name != "prior"}
        if self.how == "fovea":
            by_kind["windows"] = without_prior
        elif self.how == "windows" or self._photographs:  # a kind that is not used may know no prior
            by_kind["fovea"] = without_prior
        self._episodes: dict[str, Episode[Any]] = {
            "fovea": FoveaEpisode(fovea, target, rate=fast, start=start, seed=seed, **by_kind["fovea"]),
            "windows": windows.episode(target, targets, rate=slow, follows=True, **by_kind["windows"]),
        }
        self._check_start()

    def step(self, frame: ImageLike, passed: float = FRAME, pose: Motion | ArrayLike | None = None) -> Moment:
        """Look at the next frame.

        Args:
            frame: a picture of any common kind (`semfov.as_image`), of the same size as the first frame.
            passed: seconds since the last frame, by which evidence fades, such as the difference of two time stamps;
                what is not given is taken to be 1/25 s.
            pose: where the camera is, if that is known from a gimbal or from odometry: the map from pixels of the first
                frame to pixels of this one, a `semfov.motion.Motion` or its `(3, 3)` or `(2, 3)` matrix; for all frames
                or none. None estimates the motion from the frames (`semfov.motion.CameraMotion`).

        Returns:
            What is known at this frame: a `FoveaMoment` or a `WindowMoment`.

        Raises:
            InputError: it is no picture, or has another size, or an argument does not fit the kind of look.
            DataError: the file of the frame cannot be read.
        """
        got = "None (OpenCV gives None after the last frame, and where it cannot read one)"
        check(frame is not None, "frame", "a picture", got)
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
        """What a search needs for the decision `found`, in words, after the first frame; None for no decision."""
        return self._episodes[self.how].criterion

    def describe(self) -> str:
        """What is done in a few words."""
        return self._episodes["windows"].describe()

    def __repr__(self) -> str:
        """What is done, and the kind of look."""
        return f"{type(self).__name__}: {self.describe()}, how={self.how!r}"

    def _check_start(self) -> None:
        """Raise `InputError` for a first cell where there are no cells."""
        fits = self._start is None or self.how != "windows"
        check(fits, "start", "None for frames that are looked at by windows, or how='fovea'", self._start)
