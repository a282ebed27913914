"""The part of an agent that looks at windows of pictures larger than the detector's input, or of a stream's frames."""

from collections.abc import Sequence
from typing import Any, Self

from torch import nn

from semfov.agents.episode import EpisodeLimits, Goal, on_cpu
from semfov.agents.window_episode import PASSES, WindowEpisode, WindowStream, WindowTask
from semfov.data.classes import class_index, class_numbers
from semfov.data.inputs import ImageLike
from semfov.data.windowed import LargePicture
from semfov.detection import Detector
from semfov.detection.load import load_detector, loader_options
from semfov.errors import check, check_options
from semfov.kinds import WINDOWS
from semfov.paths import ZoomPath
from semfov.settings import ExploreSettings, FindSettings, SearchSettings, StreamSettings, value_or
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import Cut, WindowEye
from semfov.zoom.looks import LiveWindowLooks

RATE = 0.75  # default rate at which looks are forgotten in a stream, per second: a look counts for 0.9 s

_Picture = LargePicture | ImageLike


def knows_photographs(evidence: GlimpseEvidence | None) -> bool:
    """Tell whether the fitted model (`GlimpseEvidence`) is there and also covers photographs."""
    return evidence is not None and evidence.photograph is not None


def window_eye(
    detector: Detector, evidence: GlimpseEvidence | None, *, finest: float = 1.0, cut: Cut = "keep"
) -> WindowEye:
    """Make the eye that shows windows to a detector in the same way as in the fit of its models.

    Args:
        detector: any detector.
        evidence: what was fitted for it; without evidence it is shown windows as it was trained.
        finest: largest magnification, in canvas pixels per picture pixel.
        cut: treatment of boxes that the border of a window cuts (`WindowEye`).

    Returns:
        The eye.
    """
    return WindowEye(detector, finest=finest, cut=cut, stretch=None if evidence is None else evidence.stretch)


class ZoomAgent(nn.Module):
    """Agent that searches and explores pictures larger than the detector's input, by looks at windows.

    Each look is a window at a magnification and costs one pass of the detector. The agent chooses the window in which
    it expects to find most. Without evidence, it looks at slices after the overview, in the order of the overview's
    scores in them (`semfov.zoom.slices`). `semfov fit` makes evidence for a detector of your own; with it fewer passes
    find as much, and searches end early and can decide `absent`.

    Args:
        eye: resamples a window and detects in it.
        evidence: predicts from a look how many objects smaller windows show; None for slices.
        photographs: whether to look through windows at photographs, too, if there is no evidence for them.

    Attributes:
        classes: names of the classes, background first.

    Raises:
        InputError: the evidence was made for other classes, or for another detector.

    Example::

        from semfov.settings import FindSettings

        agent = ZoomAgent.recommended("yolox-nano")
        path = agent.find_all("harbour.tif", "person", FindSettings(passes=16))
        print(path.objects.boxes, path.passes)
    """

    def __init__(self, eye: WindowEye, evidence: GlimpseEvidence | None = None, photographs: bool = False) -> None:
        super().__init__()
        if evidence is not None:
            kinds = len(eye.detector.classes)
            check(evidence.classes == kinds, "evidence", f"one for the detector's {kinds} classes", evidence.classes)
            evidence.check_compatible(eye.settings())
            if evidence.metadata:  # of a fit
                expected = f"one with stretch={evidence.stretch}, as in the fit of the evidence"
                check(eye.stretch == evidence.stretch, "eye", expected, f"stretch={eye.stretch}")
        self.eye, self.evidence = eye, evidence
        self.classes = ("background", *eye.detector.classes)
        self._photographs = photographs

    @property
    def suits_photographs(self) -> bool:
        """Whether windows are used in photographs, too: if the models were fitted to them, or by request."""
        return self._photographs or knows_photographs(self.evidence)

    @classmethod
    def recommended(cls, name: str = "yolox-nano", *, finest: float = 1.0, cut: Cut = "keep", **options: Any) -> Self:
        """Create the agent with the model `GlimpseEvidence` that is shipped for a detector.

        Args:
            name: name of the detector.
            finest: largest magnification, in canvas pixels per picture pixel.
            cut: treatment of boxes that the border of a window cuts (`WindowEye`).
            **options: options of `semfov.load_detector`.

        Returns:
            The agent, in evaluation mode and without gradients.

        Raises:
            InputError: no evidence is shipped for a detector of this name.
            DataError: the weights cannot be downloaded, or they are damaged.
        """
        check_options(options, ["finest", "cut", *loader_options()], "the agent or of semfov.load_detector")
        detector = load_detector(name, **options)
        evidence = GlimpseEvidence.from_pretrained(detector.name)
        return cls(window_eye(detector, evidence, finest=finest, cut=cut), evidence).eval().requires_grad_(False)

    def search(self, picture: _Picture, target: str | int, settings: SearchSettings | None = None) -> ZoomPath:
        """Search for one object of a class and decide whether the picture holds one.

        The recommended agent enlarges places that seem to hold the class before it says `found`
        (`semfov.zoom.closer`); with evidence that has no thresholds of places it does not. Without evidence the class
        is found at a detection with a score of at least `confirm` (None: 0.5).

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            target: name or index (1..K) of the class.
            settings: the settings of the search; None for the usual ones.

        Returns:
            The looks, the objects of the class, and the decision.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or a setting is not for windows.
            DataError: the file cannot be read.
        """
        settings = SearchSettings() if settings is None else settings
        settings.check_suitable(WINDOWS)
        limits = EpisodeLimits.of(settings, PASSES)
        index = class_index(target, self.classes[1:], "target")
        return self.episode(picture, self.task(index, decisions=settings), limits).run()

    def find_all(
        self,
        picture: _Picture,
        target: str | int | Sequence[str | int] | None = None,
        settings: FindSettings | None = None,
    ) -> ZoomPath:
        """Find all objects of a class, of several or of all classes.

        With fitted evidence the scores of objects are the probabilities that box and class are right
        (`semfov.zoom.certainty`), and those from 0.5 on count. Without evidence they are the detector's, and count from
        its `score_threshold` on, mostly 0.3. In a photograph, and without evidence, slices are looked at, and
        `min_gain` and `batch` mean nothing.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            target: name or index (1..K) of the class, several in a list, or None for all. Windows for several classes
                are chosen as for all classes.
            settings: the settings of the task; None for the usual ones.

        Returns:
            The looks and the objects.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or a setting is not for windows.
            DataError: the file cannot be read.
        """
        settings = FindSettings() if settings is None else settings
        settings.check_suitable(WINDOWS)
        limits = EpisodeLimits.of(settings, PASSES)
        targets = class_numbers(target, self.classes[1:], "target")
        task = self.task(
            targets=targets, min_gain=settings.min_gain, batch=settings.batch, score_threshold=settings.score_threshold
        )
        return self.episode(picture, task, limits).run()

    def explore(self, picture: _Picture, settings: ExploreSettings | None = None) -> ZoomPath:
        """Find all objects of all classes.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            settings: the settings of the exploration; None for the usual ones.

        Returns:
            The looks and the objects.

        Raises:
            InputError: a setting is not for windows.
            DataError: the file cannot be read.
        """
        settings = ExploreSettings() if settings is None else settings
        settings.check_suitable(WINDOWS)
        limits = EpisodeLimits.of(settings, PASSES)
        return self.episode(
            picture, self.task(min_gain=settings.min_gain, score_threshold=settings.score_threshold), limits
        ).run()

    def task(self, target: int | None = None, targets: tuple[int, ...] = (), **settings: Any) -> WindowTask:
        """Make the task from its goal and the fitted models of the agent.

        Args:
            target: class 1..K to search for; None finds all objects.
            targets: classes 1..K whose objects are all to be found; none: of all classes.
            **settings: further arguments of `WindowTask`.

        Returns:
            The task, for an episode.
        """
        # The evidence computes on the CPU, where the looks are that it reads.
        evidence = None if self.evidence is None else on_cpu(self.evidence)
        goal = Goal.of(self.classes, target, targets)
        detector = self.eye.detector
        return WindowTask(goal, evidence, detector=detector.name, usual_score=detector.score_threshold, **settings)

    def episode(self, picture: _Picture, task: WindowTask, limits: EpisodeLimits | None = None) -> WindowEpisode:
        """Make the episode of looks at windows of a picture.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            task: what is looked for.
            limits: where the episode ends, unless it decides before.

        Returns:
            The episode, which looks when it is asked to.
        """
        return WindowEpisode(task, LiveWindowLooks(self.eye, self.eye.open(picture)), limits)

    def stream(
        self,
        target: int | None = None,
        targets: tuple[int, ...] = (),
        settings: StreamSettings | None = None,
        *,
        follows: bool = True,
    ) -> WindowStream:
        """Make the episode of a stream (`ActivePerception.live`).

        Args:
            target: class 1..K to search for; None finds all objects.
            targets: classes 1..K whose objects are all to be found; none: of all classes.
            settings: the settings of the task; None for the usual ones.
            follows: whether the camera's motion is estimated from the frames, where no poses are given.

        Returns:
            The episode, to which frames are given.
        """
        settings = StreamSettings() if settings is None else settings
        rate = value_or(settings.rate, RATE)
        task = self.task(target, targets, decisions=settings, score_threshold=settings.score_threshold)
        return WindowStream(task, self.eye, rate, passes=settings.passes or 1, color=settings.color, follows=follows)
