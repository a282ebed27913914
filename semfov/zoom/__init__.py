"""Pictures larger than the detector's input: where to look, and how close."""

import warnings
from typing import TYPE_CHECKING, Any

from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye, WindowView
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge

if TYPE_CHECKING:
    from semfov.zoom.export import export_look

__all__ = [
    "GlimpseEvidence",
    "Lattice",
    "WindowEye",
    "WindowView",
    "export_look",
    "merge",
]


def __getattr__(name: str) -> Any:
    if name == "export_look":
        # `semfov.zoom.export` is also a program: Python warns when it has been imported before it is run.
        from semfov.zoom.export import export_look

        return export_look
    if name in ("ZoomEye", "ZoomView"):
        new = name.replace("Zoom", "Window")
        warnings.warn(f"semfov.zoom.{name} is now semfov.zoom.{new}", DeprecationWarning, stacklevel=2)
        return globals()[new]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
