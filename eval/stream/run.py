"""Looks at streams in every way, and compares what is known at some of their frames with the annotated objects."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import process_time
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple, cast

import torch

from eval.stream.drift import Drift
from eval.stream.flights import COURSES, CourseName, Frame, film, flight, mot_film, within
from eval.stream.identity import Identities, IdentityCounts
from eval.stream.misses import MissCounts
from eval.stream.plain import PlainRule
from eval.stream.ways import AllSlices, Live, Oracle, RoundRobin, TrackedSlices, Way, WholeFrame
from semfov.agents.window_episode import LIKELY
from semfov.agents.windows import ZoomAgent, window_eye
from semfov.data.classes import class_index
from semfov.detection.objects import Objects
from semfov.errors import check
from semfov.io.ranges import Count, Positive, Range, Seed, Whole
from semfov.observation.matching import right_boxes
from semfov.runs.config import DataConfig, DetectorConfig
from semfov.runs.progress import track
from semfov.runs.results import ResultRecord
from semfov.runs.settings import Settings
from semfov.runs.setup import check_sources, make_detector, make_scenes
from semfov.settings import StreamSettings
from semfov.zoom.evidence import GlimpseEvidence

WayName = Literal["whole", "slices", "bytetrack", "in-turn", "in-turn-carried", "plain", "live", "live-known", "oracle"]
_Length = Annotated[int, Range(64, 16_384)]
FILM = "film"
"""The course of a film in tables."""


@dataclass(frozen=True)
class StreamConfig(Settings):
    """Streams of a camera that moves: average precision of what is known at each frame.

    Args:
        data: the pictures to fly over.
        detector: the detector.
        model: fitted evidence by magnification, by name or file (None: the one shipped for the detector).
        target: class whose objects are to be found.
        ways: ways of looking.
        courses: courses of the camera: `still`, `slow` (4 px a frame), `usual` (12 px), `fast` (30 px), `turning` (12
            px, .4 degrees and .4 % of the scale), `shaking` (4 px, and a standard deviation of 3 px). In `moving`
            (camera still) and `moving-slow` (4 px) 24 pasted objects move on their own, by 3 to 10 px a frame.
        successive: the pictures are the frames of one film, in the order of their ids.
        film: folder of a film in the form of MOTChallenge, in place of pictures.
        width: width of the frames of a flight in pixels.
        height: height of the frames of a flight in pixels.
        frames: number of frames of a flight.
        every: each of so many frames is judged.
        after: the figures of all judged frames leave out those up to this one.
        rate: rate at which the agent forgets looks, per second of 25 frames.
        passes: passes of the agent at each frame; each of several numbers is a row.
        seed: random seed of the flights.
        out: folder for tables and records.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(name="yolox-nano"))
    model: str | None = None
    target: str = "person"
    ways: tuple[WayName, ...] = ("whole", "slices", "in-turn", "in-turn-carried", "plain", "live")
    courses: tuple[CourseName, ...] = ("still", "slow", "usual", "fast", "turning", "shaking")
    successive: bool = False
    film: Path | None = None
    width: _Length = 1920
    height: _Length = 1080
    frames: Count = 48
    every: Count = 8
    after: Whole = 8
    rate: Positive = 0.75
    passes: tuple[Count, ...] = (1,)
    seed: Seed = 0
    out: Path = Path("runs/stream")


class Cost(NamedTuple):
    """What a way of looking at frames takes: passes of the detector a frame, and milliseconds of the processor."""

    passes: int
    milliseconds: float


class StreamOutcome(NamedTuple):
    """What each way of looking knows at the judged frames of a stream, what it takes, and the drift of the motion.

    `identities` has the ways that tell numbers of objects, in all frames after `StreamConfig.after`, and `misses` what
    the agent does not list of them.
    """

    course: str
    records: list[ResultRecord]
    costs: Mapping[str, Cost]
    drift: Drift
    identities: Mapping[str, IdentityCounts]
    misses: Mapping[str, MissCounts] = MappingProxyType({})

    @property
    def title(self) -> str:
        """The course in words."""
        return FILM if self.course == FILM else COURSES[cast(CourseName, self.course)].describe()


class StreamRun:
    """The streams of the settings, and the ways of looking at them."""

    def __init__(self, config: StreamConfig) -> None:
        self.config = config
        check_sources(config.data, config.detector)
        detector = make_detector(config.detector)
        evidence = GlimpseEvidence.from_pretrained(config.model or detector.name).requires_grad_(False)
        self.eye = window_eye(detector, evidence).eval().requires_grad_(False)
        self.agent = ZoomAgent(self.eye, evidence)
        self.target = class_index(config.target, detector.classes, "target")

    def outcomes(self) -> Iterator[StreamOutcome]:
        """Look at each stream in every way."""
        for course, name, frames in self._streams():
            yield self._look(course, name, frames)

    def _streams(self) -> Iterator[tuple[str, str, Iterator[Frame]]]:
        """Yield the course, the name and the frames of each stream."""
        config = self.config
        if config.film is not None:
            yield FILM, config.film.name, mot_film(config.film, self.target)
            return
        scenes = make_scenes(config.data, self.eye.detector.classes)
        if config.successive:
            yield FILM, FILM, film(scenes)
            return
        last = config.frames - config.frames % config.every
        check(last > config.after, "frames", f"{config.every} or more after frame {config.after}", config.frames)
        size = config.width, config.height
        for number in track(range(len(config.courses) * len(scenes)), "flying", "flight"):
            course, index = config.courses[number // len(scenes)], number % len(scenes)
            scene = scenes[index]
            yield course, scene.name, flight(scene, COURSES[course], size, config.frames, config.seed + index)

    def _ways(self) -> list[Way]:
        """Return the ways of looking, each with an empty memory."""
        eye, target, config = self.eye, self.target, self.config

        def agents(*, poses: bool) -> list[Way]:
            ways: list[Way] = []
            for passes in config.passes:
                episode = self.agent.stream(None, (target,), StreamSettings(rate=config.rate, passes=passes))
                ways.append(Live(eye, target, episode, poses=poses))
            return ways

        makers: dict[WayName, Callable[[], list[Way]]] = {
            "whole": lambda: [WholeFrame(eye, target)],
            "slices": lambda: [AllSlices(eye, target)],
            "bytetrack": lambda: [TrackedSlices(eye, target)],
            "in-turn": lambda: [RoundRobin(eye, target, carries=False)],
            "in-turn-carried": lambda: [RoundRobin(eye, target, carries=True)],
            "plain": lambda: [PlainRule(eye, target)],
            "live": lambda: agents(poses=False),
            "live-known": lambda: agents(poses=True),
            "oracle": lambda: [Oracle(eye, target)],
        }
        return [way for name in config.ways for way in makers[name]()]

    @torch.inference_mode()
    def _look(self, course: str, name: str, frames: Iterator[Frame]) -> StreamOutcome:
        """Look at the frames of a stream in every way; what remembers nothing looks at the judged ones alone."""
        ways, drift = self._ways(), Drift()
        seconds: dict[str, float] = defaultdict(float)
        steps = Counter[str]()
        passes: dict[str, int] = {}
        records: list[ResultRecord] = []
        identities: dict[str, Identities] = {}
        for number, frame in enumerate(frames, 1):
            drift.step(frame)
            judged = number % self.config.every == 0
            for way in (way for way in ways if judged or way.remembers):
                began = process_time()
                known = way.step(frame)
                took = process_time() - began
                if isinstance(way, Live):
                    way.find_misses(frame, counts=number > self.config.after)
                for row, objects in known.items():
                    if number > self.config.after and objects.track_ids is not None and frame.identities is not None:
                        compare_identities(identities.setdefault(row, Identities()), objects, frame, self.target)
                    seconds[row] += took
                    steps[row] += 1
                    passes[row] = way.passes
                    if judged:
                        where = {"course": course, "stream": name, "frame": number, "way": row}
                        records.append({**where, **judged_objects(objects, frame, self.target)})
        costs = {row: Cost(passes[row], 1000 * seconds[row] / steps[row]) for row in passes}
        counts = {row: each.counts() for row, each in identities.items()}
        misses = {way.name: way.misses.counts for way in ways if isinstance(way, Live)}
        return StreamOutcome(course, records, costs, drift, counts, misses)


def compare_identities(identities: Identities, objects: Objects, frame: Frame, target: int) -> None:
    """Compare the numbers of objects with those of the annotated ones of a class."""
    assert frame.identities is not None
    assert objects.track_ids is not None
    annotation = frame.annotation
    mine = annotation.labels == target
    moving = None if frame.moving is None else frame.moving[mine]
    boxes = within(objects.boxes, annotation.size)
    identities.step(frame.identities[mine], annotation.boxes[mine], objects.track_ids, boxes, moving)


def judged_objects(objects: Objects, frame: Frame, target: int) -> ResultRecord:
    """Compare objects with the annotated ones of a class, both cut at the borders of the frame; crowds are left out.

    Those with a score of one half or more are listed, as the agent lists objects.
    """
    annotation = frame.annotation
    truth = annotation.take(annotation.labels == target)
    right = right_boxes(replace(objects, boxes=within(objects.boxes, annotation.size)), truth)
    counts = right >= 0
    listed = counts & (objects.scores >= LIKELY)
    return {
        "objects": int((~truth.crowd).sum()),
        "scores": objects.scores[counts].tolist(),
        "right": (right[counts] > 0).tolist(),
        "listed": int(listed.sum()),
        "listed right": int((right[listed] > 0).sum()),
    }
