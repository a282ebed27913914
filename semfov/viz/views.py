"""The foveated views that the detector was given during an episode."""

from torch import Tensor

from semfov.eye import Eye
from semfov.paths import Stimulus


def foveated_views(eye: Eye, image: Tensor, fixations: Tensor) -> list[Tensor]:
    """The images that the detector is given from each fixation, without the padding around the picture.

    They have the detector's resolution. The scanpath of an agent keeps what is needed to compute them
    (`Scanpath.views`).

    Args:
        eye: sensor and detector.
        image: `(3, H, W)`, RGB in [0, 1].
        fixations: `(n, 2)`, in pixels of the image.

    Returns:
        n views `(3, h, w)`.
    """
    return Stimulus.of(eye, image).views(fixations)
