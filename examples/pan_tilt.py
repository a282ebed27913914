"""Search a room with a simulated pan-tilt camera: motors take time, frames come late, and directions are a little off.

Run it from a checkout: python -m examples.pan_tilt PANORAMA.jpg cup --out found.png
"""

import argparse
import math
import random
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semfov
from semfov.head import CameraFrame, Panoramas, PanTiltCamera, Speeds
from semfov.viz import save_figure


class SimulatedCamera(PanTiltCamera):
    """A pan-tilt camera that stands in the middle of a panorama, with a clock of its own.

    It stops within `noise` degrees of the direction that it is sent to. Frames arrive 15 times a second, each `delay`
    seconds after it was taken, with channels in the order of OpenCV. `look_at` returns the next frame that arrives
    after the motors have stopped, which can have been taken while they moved.

    Args:
        panorama: what there is to see.
        delay: age of a frame when it arrives, in seconds.
        noise: standard deviation of the direction at which it stops, in degrees.
        reports: whether frames come with the direction they were taken from. A camera that does not know it waits until
            a frame must be new.
        seed: seed of the noise.

    Attributes:
        clock: time in seconds since the start.
        turns: number of movements.
    """

    size = (416, 312)
    pan = (-170.0, 170.0)
    tilt = (-30.0, 60.0)
    interval = 1 / 15

    def __init__(
        self, panorama: semfov.Panorama, *, delay: float = 0.3, noise: float = 0.5, reports: bool = True, seed: int = 0
    ) -> None:
        self.panorama, self.delay, self.noise, self.reports = panorama, delay, noise, reports
        self.speeds = Speeds(look=self.interval, eye_start=0.0, eye=0.0, head=90.0, acceleration=200.0, settle=delay)
        self.clock, self.turns = 0.0, 0
        self._random = random.Random(seed)
        self._sent = (0.0, 0.0)
        # The last movement: its start, its end, and where it leads from and to.
        self._move = (0.0, 0.0, self._sent, self._sent)

    def look_at(self, direction: tuple[float, float], field: float) -> CameraFrame | NDArray[np.uint8]:
        """Turn to a direction, wait until the motors have stopped, and take the next frame that arrives."""
        if direction != self._sent:
            self._send(direction)
        self.clock += self.interval
        pan_tilt = self.where(self.clock - self.delay)
        # What `cv2.VideoCapture.read` returns: bytes (H, W, 3), blue first.
        pixels = self.panorama.look_at(pan_tilt, field).mul(255).byte().permute(1, 2, 0).flip(-1).numpy()
        return CameraFrame(pixels, pan_tilt) if self.reports else pixels

    def _send(self, direction: tuple[float, float]) -> None:
        here = self.where(self.clock)
        stop = tuple(angle + self._random.gauss(0, self.noise) for angle in direction)
        angle = max(abs(a - b) for a, b in zip(here, stop, strict=True))
        speed, acceleration = self.speeds.head, self.speeds.acceleration
        fast = speed**2 / acceleration
        takes = 2 * math.sqrt(angle / acceleration) if angle <= fast else angle / speed + speed / acceleration
        self._sent, self._move = direction, (self.clock, self.clock + takes, here, (stop[0], stop[1]))
        self.turns += 1
        self.clock += takes + (0.0 if self.reports else self.delay)

    def where(self, time: float) -> tuple[float, float]:
        """Pan and tilt at a time, as far back as the last movement."""
        begins, ends, one, other = self._move
        share = min(max((time - begins) / max(ends - begins, 1e-9), 0.0), 1.0)
        share *= share * (3 - 2 * share)  # gently away, and gently to a stop
        return one[0] + share * (other[0] - one[0]), one[1] + share * (other[1] - one[1])


def main() -> None:
    """Search a panorama, or one made of embedded scenes if none is given, with a simulated camera."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("panorama", nargs="?", help="image file (default: embedded scenes on a sphere)")
    parser.add_argument("target", nargs="?", default="horse", help="class to search for")
    parser.add_argument("--delay", type=float, default=0.3, help="age of frames in seconds (default: 0.3)")
    parser.add_argument("--noise", type=float, default=0.5, help="error of directions in degrees (default: 0.5)")
    parser.add_argument("--blind", action="store_true", help="the camera does not report its direction")
    parser.add_argument("--seconds", type=float, default=20.0, help="maximum duration in the room (default: 20)")
    parser.add_argument("--out", default="pan_tilt.png", help="figure to write (default: pan_tilt.png)")
    arguments = parser.parse_args()

    agent = semfov.ActivePerception.recommended()
    picture = arguments.panorama
    if picture is None:
        scenes = semfov.EmbeddedScenes(agent.classes[1:], count=12)
        picture = Panoramas(scenes, width=2048, count=1)[0].image
    panorama = semfov.Panorama(picture)
    camera = SimulatedCamera(panorama, delay=arguments.delay, noise=arguments.noise, reports=not arguments.blind)

    path: Any = agent.search(camera, arguments.target, duration=arguments.seconds, color="bgr")
    for number, seconds in enumerate(path.seconds):
        pan, tilt, _ = path.pose(number).tolist()
        print(f"{seconds:5.2f} s: camera at pan {pan:.0f}°, tilt {tilt:.0f}°")
    pan, tilt = path.direction(-1)
    print(f"{path.summary()} The last gaze was at pan {pan:.1f}°, tilt {tilt:.1f}°.")
    print(f"the camera's clock says {camera.clock:.2f} s, and {camera.turns} turns")
    save_figure(path.plot(), arguments.out)


if __name__ == "__main__":
    main()
