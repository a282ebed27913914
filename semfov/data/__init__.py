"""Images, annotated scenes and their sources."""

from typing import TYPE_CHECKING, Any

from semfov.data.classes import canonical_name, class_index
from semfov.data.images import read_image
from semfov.data.inputs import as_image
from semfov.data.scene import Annotation, Scene, Scenes, box_coverage, legal_targets
from semfov.data.scenes import EmbeddedScenes
from semfov.data.word_vectors import WordVectors, spread

if TYPE_CHECKING:
    from semfov.data.coco import CocoScenes

__all__ = [
    "Annotation",
    "CocoScenes",
    "EmbeddedScenes",
    "Scene",
    "Scenes",
    "WordVectors",
    "as_image",
    "box_coverage",
    "canonical_name",
    "class_index",
    "legal_targets",
    "read_image",
    "spread",
]


def __getattr__(name: str) -> Any:
    # semfov.data.coco is also a program, which Python warns about when its package has imported it already
    if name == "CocoScenes":
        from semfov.data.coco import CocoScenes

        return CocoScenes
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
