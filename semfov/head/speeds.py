"""The time that movements of eye and head take."""

from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.errors import check_number

_STILL = 1e-3  # degrees; smaller angles are rounding errors of 0


@dataclass(frozen=True)
class Speeds:
    r"""Durations of looks and of movements of eye, head and zoom.

    Larger saccades last longer (the main sequence: Bahill, Clark and Stark, 1975). A saccade of amplitude A in degrees
    takes :math:`21 + 2.2 A` ms, the line of Carpenter (Movements of the Eyes, 1988). The head is a motor with bounded
    speed v and acceleration a. It turns by an angle A in the shortest possible time,

    .. math:: t = 2 \sqrt{A / a} \ \text{ for } A \le v^2 / a, \quad \text{else } \frac{A}{v} + \frac{v}{a}

    Eye, head and zoom move at the same time, and the look follows when all have arrived. After a movement of the head
    or of the zoom it also waits until a frame is sharp and has reached this machine.

    Attributes:
        look: duration of a fixation with its pass of the detector, in seconds.
        eye_start: duration of the smallest saccade, in seconds.
        eye: additional seconds for each degree of a saccade.
        head: v, degrees per second.
        acceleration: a, degrees per second squared.
        zoom: seconds for each doubling or halving of the field of view.
        settle: seconds from the end of a movement of head or zoom to a frame that shows its result.
        dead_zone: degrees; a smaller turn of the head is not made.

    >>> speeds = Speeds()
    >>> round(float(speeds.saccade(torch.tensor(10.0))), 3), round(float(speeds.turn(torch.tensor(90.0))), 3)
    (0.043, 1.15)
    """

    look: float = 0.25
    eye_start: float = 0.021
    eye: float = 0.0022
    head: float = 100.0
    acceleration: float = 400.0
    zoom: float = 0.5
    settle: float = 0.0
    dead_zone: float = 0.0

    def __post_init__(self) -> None:
        for name in ("look", "eye_start", "eye", "zoom", "settle", "dead_zone"):
            check_number(getattr(self, name), name, 0, 1e6)
        for name in ("head", "acceleration"):
            check_number(getattr(self, name), name, 1e-6, 1e9)
        check_number(self.look, "look", 1e-6, 1e6)

    def saccade(self, angle: Tensor) -> Tensor:
        """Compute the duration of saccades.

        Args:
            angle: `(...)`, amplitudes in degrees.

        Returns:
            `(...)`, seconds; 0 where the eye stays.
        """
        return torch.where(angle > _STILL, self.eye_start + self.eye * angle, 0.0)

    def turn(self, angle: Tensor) -> Tensor:
        """Compute the duration of turns of the head.

        Args:
            angle: `(...)`, in degrees.

        Returns:
            `(...)`, seconds; 0 where the head stays.
        """
        angle = torch.where(angle > _STILL, angle, 0.0)
        # Half of a short turn is accelerated, and half is slowed down. `reaches_speed` degrees are the shortest turn in
        # which the head has its full speed for a moment.
        reaches_speed = self.head**2 / self.acceleration
        accelerated = 2 * (angle / self.acceleration).sqrt()
        cruising = angle / self.head + self.head / self.acceleration
        return torch.where(angle <= reaches_speed, accelerated, cruising)

    def makes(self, angle: Tensor) -> Tensor:
        """Tell which turns of the head are possible: no turn, and turns beyond the dead zone.

        Args:
            angle: `(...)`, in degrees.

        Returns:
            `(...)`, boolean.
        """
        return (angle <= _STILL) | (angle >= self.dead_zone)

    def duration(self, eye: Tensor, head: Tensor, octaves: Tensor) -> Tensor:
        """Compute the duration of a gaze shift and its look: of the slowest movement, of settling, and of the look.

        Args:
            eye: `(...)`, amplitude of the saccade in degrees.
            head: `(...)`, angle of the head's turn in degrees.
            octaves: `(...)`, change of the field of view, in doublings; the sign does not matter.

        Returns:
            `(...)`, seconds.
        """
        octaves = octaves.abs()
        # Eye, head and lens move at the same time.
        slowest = torch.maximum(self.saccade(eye), self.turn(head))
        slowest = torch.maximum(slowest, self.zoom * octaves)
        moves = (head > _STILL) | (octaves > _STILL)
        return self.look + slowest + self.settle * moves
