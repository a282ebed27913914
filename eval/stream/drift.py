"""How far the motion that is estimated from frames leads from the known one."""

from time import process_time

import numpy as np
import torch

from eval.stream.flights import Frame
from semfov.motion import CameraMotion, Motion


class Drift:
    """The drift of `CameraMotion`: how far the centre of each frame is from its place by the motions since the first.

    Attributes:
        pixels: the drift in each frame whose pose is known, in pixels of the frame.
        lost: number of frames that were said to fit none before; from such a frame on, drift begins at 0.
        seconds: time of the processor.
        frames: number of frames.
    """

    def __init__(self) -> None:
        self.pixels: list[float] = []
        self.lost = 0
        self.seconds = 0.0
        self.frames = 0
        self._camera = CameraMotion()
        self._since = Motion.still()
        self._first: Motion | None = None

    def step(self, frame: Frame) -> None:
        """Take the next frame."""
        began = process_time()
        motion = self._camera.step(frame.pixels).motion
        self.seconds += process_time() - began
        self.frames += 1
        if motion is None:
            self.lost += self.frames > 1
            self._since, self._first = Motion.still(), frame.pose
            return
        self._since = self._since.then(motion)
        if frame.pose is not None and self._first is not None:
            centre = torch.tensor(frame.annotation.size, dtype=torch.float64)[None] / 2
            known = self._first.points(frame.pose.inverse().points(centre))
            self.pixels.append(float(np.linalg.norm(self._since.points(known) - centre)))
