"""Detectors and their detections: boxes with full class-score vectors."""

from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import FeatureMaps
from semfov.detection.objects import SCORE_THRESHOLD, Objects, merge_boxes
from semfov.detection.placement import Placement, letterbox
from semfov.detection.scores import BackgroundPolicy, Candidates, score_vectors
from semfov.detection.selection import Selection

__all__ = [
    "BackgroundPolicy",
    "Candidates",
    "Detections",
    "Detector",
    "FeatureMaps",
    "SCORE_THRESHOLD",
    "Objects",
    "Placement",
    "Selection",
    "letterbox",
    "merge_boxes",
    "score_vectors",
]
