"""Search a room with a simulated pan-tilt camera: motors take time, frames come late, and directions are a little off.

Run it from a checkout: python -m examples.pan_tilt PANORAMA.jpg cup --out found.png
"""

import argparse
import math
import random
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import semfov
from semfov.head import CameraFrame, Panoramas, PanTiltCamera, Speeds
from semfov.viz import save_figure

Direction = tuple[float, float]
"""Pan and tilt in degrees."""


@dataclass(frozen=True)
class Movement:
    """A movement from one direction to another, between two times in seconds."""

    begin: float
    end: float
    start: Direction
    stop: Direction

    def at(self, time: float) -> Direction:
        """Tell the direction at a time; before and after the movement it rests."""
        duration = max(self.end - self.begin, 1e-9)
        share = min(max((time - self.begin) / duration, 0.0), 1.0)
        way = share * (share * (3 - 2 * share))  # gently away, and gently to a stop
        pan, tilt = self.start
        return pan + way * (self.stop[0] - pan), tilt + way * (self.stop[1] - tilt)


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
        self,
        panorama: semfov.Panorama,
        *,
        delay: float = 0.3,
        noise: float = 0.5,
        reports: bool = True,
        seed: int = 0,
    ) -> None:
        self.panorama = panorama
        self.delay = delay
        self.noise = noise
        self.reports = reports
        self.speeds = Speeds(look=self.interval, eye_start=0.0, eye=0.0, head=90.0, acceleration=200.0, settle=delay)
        self.clock = 0.0
        self.turns = 0
        self._random = random.Random(seed)
        self._sent: Direction = (0.0, 0.0)
        self._movement = Movement(0.0, 0.0, self._sent, self._sent)

    def look_at(self, direction: Direction, field: float) -> CameraFrame | NDArray[np.uint8]:
        """Turn to a direction, wait until the motors have stopped, and take the next frame that arrives."""
        if direction != self._sent:
            self._turn(direction)
        self.clock += self.interval
        pan_tilt = self.where(self.clock - self.delay)
        # What `cv2.VideoCapture.read` returns: bytes (H, W, 3), blue first.
        view = self.panorama.look_at(pan_tilt, field)
        pixels = view.mul(255).byte().permute(1, 2, 0).flip(-1).numpy()
        return CameraFrame(pixels, pan_tilt) if self.reports else pixels

    def _turn(self, direction: Direction) -> None:
        """Turn to a direction, or beside it by the noise, and wait until the motors have stopped."""
        here = self.where(self.clock)
        pan, tilt = direction
        stop = (pan + self._random.gauss(0, self.noise), tilt + self._random.gauss(0, self.noise))
        # The motors turn together, so the longer way decides.
        seconds = self._seconds(max(abs(here[0] - stop[0]), abs(here[1] - stop[1])))
        self._sent = direction
        self._movement = Movement(self.clock, self.clock + seconds, here, stop)
        self.turns += 1
        unseen = 0.0 if self.reports else self.delay  # until a frame must be new
        self.clock += seconds + unseen

    def _seconds(self, angle: float) -> float:
        """Compute how long a motor takes for an angle: it accelerates, turns at its speed, and brakes."""
        speed = self.speeds.head
        acceleration = self.speeds.acceleration
        # In a short movement it brakes before it has reached its speed.
        if angle <= speed**2 / acceleration:
            return 2 * math.sqrt(angle / acceleration)
        return angle / speed + speed / acceleration

    def where(self, time: float) -> Direction:
        """Tell pan and tilt at a time, as far back as the last movement."""
        return self._movement.at(time)


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
