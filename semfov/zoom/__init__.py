"""Pictures larger than the detector's input: where to look, and how close."""

from semfov.zoom.agent import ZoomAgent
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import ZoomEye, ZoomView
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import Objects, merge
from semfov.zoom.search import ZoomPath

__all__ = ["GlimpseEvidence", "Lattice", "Objects", "ZoomAgent", "ZoomEye", "ZoomPath", "ZoomView", "merge"]
