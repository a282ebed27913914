"""Pictures larger than the detector's input: where to look, and how close."""

from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye, WindowView
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge

__all__ = ["GlimpseEvidence", "Lattice", "WindowEye", "WindowView", "merge"]
