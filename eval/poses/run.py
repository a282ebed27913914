"""Follows the camera through hard pairs of frames, and counts the motions that are wrong, right and doubted."""

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch

from eval.comparison.summary import announce, write_summary
from eval.poses.pairs import KINDS, Film, Pixels, Stage, View
from semfov.data.examples import EXAMPLES, example
from semfov.data.reading import read_image
from semfov.errors import check_data
from semfov.io.ranges import Count, Seed
from semfov.motion import CameraMotion, CameraStep, Motion
from semfov.runs.progress import track
from semfov.runs.results import ResultRecord
from semfov.runs.settings import Settings
from semfov.runs.tables import table

Verdict = Literal["wrong", "right", "doubted"]

WRONG = 5.0
"""Pixels of a frame 1920 pixels wide by which a motion is wrong."""

_SUFFIXES = (".jpg", ".jpeg", ".png")
_PLACES = 7  # rows and columns of places in a frame at which motions are compared
_LARGE = 2000  # pixels: longer pictures are halved, which changes nothing of the reduced frames and saves time


@dataclass(frozen=True)
class PosesConfig(Settings):
    """Motions of a camera between frames that are hard to match: how many are believed, and how many of these wrong.

    Args:
        pictures: folders of photographs; none for the embedded ones.
        limit: most photographs of each folder.
        count: films of each kind.
        seed: random seed of the films.
        out: folder for the table and the records.
    """

    pictures: tuple[Path, ...] = ()
    limit: Count = 26
    count: Count = 10
    seed: Seed = 0
    out: Path = Path("runs/poses")


def judge_all(config: PosesConfig) -> None:
    """Follow the camera through all films, and write the table and the records."""
    pictures = _pictures(config)
    records: list[ResultRecord] = []
    for name in track(KINDS, "hard pairs", "kind"):
        for number in range(config.count):
            film = KINDS[name](Stage(pictures, config.count * config.seed + number))
            records.append({"kind": name, "number": number, "verdict": judge(film)})
    text = summary(records)
    announce(text, write_summary(config.out, "poses", text, records))


def summary(records: list[ResultRecord]) -> str:
    """Make the table of verdicts by kind, and of all."""
    rows = [["films of each kind", "wrong", "right", "doubted"]]
    for kind in [*dict.fromkeys(record["kind"] for record in records), None]:
        counts = Counter(record["verdict"] for record in records if kind in (record["kind"], None))
        cells = [str(counts[verdict]) for verdict in ("wrong", "right", "doubted")]
        rows.append([kind or "all", *cells])
    return "\n".join([f"# Hard pairs of frames, {len(records)} films", "", *table(rows), ""])


def judge(film: Film) -> Verdict:
    """Follow the camera through a film.

    Args:
        film: its frames, and where the camera was.

    Returns:
        Whether any motion that was believed within a scene is wrong, be it of a frame since the last one or of the last
        frame since the first one; else whether the motion of the last frame was believed.
    """
    camera = CameraMotion()
    memory = _Memory()
    step = camera.step(film[0].pixels)
    for before, view in pairwise(film):
        step = camera.step(view.pixels)
        memory.follow(step)
        if step.motion is not None and before.scene == view.scene and error(step.motion, before, view) > WRONG:
            return "wrong"
    if memory.since_first is not None and error(memory.since_first, film[0], film[-1]) > WRONG:
        return "wrong"
    return "doubted" if step.motion is None else "right"


class _Memory:
    """What a stream makes of motions: a memory of the first frame is carried along, set aside, found again or dropped.

    Attributes:
        since_first: the motion since the first frame; None where its memory was set aside or dropped.
    """

    def __init__(self) -> None:
        self.since_first: Motion | None = Motion.still()
        self._aside: Motion | None = None

    def follow(self, step: CameraStep) -> None:
        """Take the next step."""
        if self.since_first is not None:
            self._aside = self.since_first
            self.since_first = None if step.motion is None else self.since_first.then(step.motion)
        if self.since_first is None and self._aside is not None and step.recovered is not None:
            self.since_first = self._aside.then(step.recovered)
        if not step.waits:
            self._aside = None


def error(motion: Motion, before: View, after: View) -> float:
    """Compute how far a motion takes places of a frame from where they are in another one, in the mean.

    Args:
        motion: the motion.
        before: the view whose places are moved.
        after: the other one.

    Returns:
        Pixels of a frame 1920 pixels wide; infinite where the views have no place in common.
    """
    if before.scene != after.scene or before.pose is None or after.pose is None:
        return float("inf")
    height, width = after.pixels.shape[:2]
    columns, rows = np.meshgrid(np.linspace(0, width - 1, _PLACES), np.linspace(0, height - 1, _PLACES))
    places = torch.from_numpy(np.stack([columns.ravel(), rows.ravel()], -1))
    truth = after.pose.points(before.pose.inverse().points(places))
    if after.bend is not None:
        truth = after.bend(truth)
    shown = ((truth >= 0) & (truth <= truth.new_tensor([width - 1, height - 1]))).all(-1)
    if not shown.any():
        return float("inf")
    return float((motion.points(places) - truth)[shown].norm(dim=-1).mean()) * 1920 / width


def _pictures(config: PosesConfig) -> list[Pixels]:
    """Read the photographs, long ones at half their size."""
    images = [] if config.pictures else [example(name) for name in EXAMPLES]
    for folder in config.pictures:
        files = sorted(path for path in folder.glob("*") if path.suffix.lower() in _SUFFIXES)
        check_data(bool(files), f"pictures {folder}", f"photographs ({', '.join(_SUFFIXES)})", "none")
        images += [read_image(path) for path in files[: config.limit]]
    pictures = []
    for image in images:
        pixels = np.ascontiguousarray((image * 255).round().byte().permute(1, 2, 0).numpy())
        if max(pixels.shape) > _LARGE:
            pixels = np.asarray(cv2.resize(pixels, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        pictures.append(pixels)
    return pictures
