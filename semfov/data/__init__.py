"""Images, annotated scenes and their sources."""

from semfov.data.classes import canonical_name, class_index
from semfov.data.coco import CocoScenes
from semfov.data.examples import example
from semfov.data.inputs import as_image
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, Scene, Scenes, box_coverage, legal_targets
from semfov.data.scenes import EmbeddedScenes
from semfov.data.word_vectors import WordVectors, spread

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
    "example",
    "legal_targets",
    "read_image",
    "spread",
]
