"""Where an image attracts the gaze without a task: a density fitted to people, and bottom-up saliency.

VOCUS2 is the baseline of Luzio, Bernardino and Moreno (2024, section IV-B), computed anew on the foveated view of every
fixation. VOCUS2 builds on the model of Itti, Koch and Niebur; the paper has no figures for that model.
"""

from typing import TYPE_CHECKING

from semfov.gaze.saliency.cells import cell_saliency
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.gaze.saliency.glimpses import features_so_far
from semfov.gaze.saliency.likeness import PictureLikeness
from semfov.gaze.saliency.oculomotor import OculomotorBias

if TYPE_CHECKING:
    from semfov.baselines.saliency import VOCUS2, IttiKoch, itti_koch_saliency, vocus2_saliency

__all__ = [
    "VOCUS2",
    "FixationDensity",
    "IttiKoch",
    "OculomotorBias",
    "PictureLikeness",
    "cell_saliency",
    "features_so_far",
    "itti_koch_saliency",
    "vocus2_saliency",
]


def __getattr__(name: str) -> object:
    """Import a baseline when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import semfov.baselines.saliency

    return getattr(semfov.baselines.saliency, name)
