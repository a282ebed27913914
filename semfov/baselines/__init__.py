"""Others' models that semfov is compared with: bottom-up saliency, and ideal searchers.

Their public names are in `semfov.saliency` and `semfov.acquisition`. An agent looks by none of them.
"""

from semfov.baselines.ideal import CorrectLocalisation, EntropyLimit
from semfov.baselines.itti import IttiKoch, itti_koch_saliency
from semfov.baselines.vocus2 import VOCUS2, vocus2_saliency

__all__ = [
    "VOCUS2",
    "CorrectLocalisation",
    "EntropyLimit",
    "IttiKoch",
    "itti_koch_saliency",
    "vocus2_saliency",
]
