"""Others' models of bottom-up saliency."""

from semfov.baselines.saliency.itti import IttiKoch, itti_koch_saliency
from semfov.baselines.saliency.vocus2 import VOCUS2, vocus2_saliency

__all__ = ["VOCUS2", "IttiKoch", "itti_koch_saliency", "vocus2_saliency"]
