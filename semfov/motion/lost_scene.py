"""Memory of a scene that the camera has lost: kept for some frames, and used if the scene comes back.

What is kept so: looks at windows (`semfov.zoom.episode`, `semfov.agents.window_episode`), candidates and places of
closer looks (`semfov.decision.candidates`, `semfov.decision.verifier`), and tracked objects
(`semfov.tracking.tracker`). A belief by windows is made anew of the looks that are left, with none from a new look at
the whole.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

from semfov.motion.camera import CameraStep
from semfov.motion.motion import Motion

_Thing = TypeVar("_Thing")


class LostScene(Generic[_Thing]):
    """What was known of the scene before it was lost, at its places in the last frame that showed it.

    Attributes:
        things: what was known; None while the camera has lost no scene that it may find again.

    >>> import torch
    >>> lost = LostScene()
    >>> shift = lambda boxes, motion: [motion.boxes(box) for box in boxes]
    >>> lost.follow([torch.tensor([20.0, 10.0, 40.0, 60.0])], CameraStep(None, waits=True), shift)
    []
    >>> lost.follow([], CameraStep(None, recovered=Motion.similarity(shift=(8, 0))), shift)
    [tensor([28., 10., 48., 60.])]
    """

    def __init__(self) -> None:
        self.things: list[_Thing] | None = None

    def follow(
        self, things: list[_Thing], camera: CameraStep, carry: Callable[[list[_Thing], Motion], list[_Thing]]
    ) -> list[_Thing]:
        """Move what is known with the camera, set it aside if the scene is lost, or restore it.

        Args:
            things: what is known of the scene in the last frame.
            camera: how the camera moved since then.
            carry: carries things along with a motion.

        Returns:
            What is known of the scene in the present frame; what was found again is first.
        """
        if camera.motion is not None:
            present = carry(things, camera.motion)
        else:
            # What was known of a scene between two disturbances is dropped: the first scene alone may be found again.
            self.things = things if self.things is None else self.things
            present = []
        if camera.recovered is not None and self.things is not None:
            present = [*carry(self.things, camera.recovered), *present]
        if camera.recovered is not None or not camera.waits:
            self.things = None
        return present
