"""Measures of scanpaths: people compared with people, and models compared with people.

Fixations are arrays of points in any one unit. Maps are arrays `(H, W)` whose pixel centres are at integers.
Definitions differ between groups, and each function names the group whose definition it computes. Functions on
sequences need `pip install semfov[human]`.
"""

from semfov.human.scanpath.alignment import (
    MultiMatch,
    dynamic_time_warping,
    multimatch,
    scanmatch,
    time_delay_embedding,
)
from semfov.human.scanpath.beside import BesidePeople, ScanpathComparison, compare_scanpath
from semfov.human.scanpath.maps import (
    auc,
    auc_borji,
    auc_judd,
    auc_shuffled,
    correlation,
    information_gain,
    kullback_leibler,
    log_density,
    log_likelihood,
    nss,
    similarity,
)
from semfov.human.scanpath.performance import (
    found_at,
    mean_performance,
    performance_area,
    probability_mismatch,
    scanpath_ratio,
    tfp_auc,
)
from semfov.human.scanpath.saccades import direction_distance, length_distance, saccades
from semfov.human.scanpath.sequence import (
    cell_labels,
    cluster_labels,
    edit_distance,
    merge_close,
    sequence_score,
)

__all__ = [
    "BesidePeople",
    "MultiMatch",
    "ScanpathComparison",
    "auc",
    "auc_borji",
    "auc_judd",
    "auc_shuffled",
    "cell_labels",
    "cluster_labels",
    "compare_scanpath",
    "correlation",
    "direction_distance",
    "dynamic_time_warping",
    "edit_distance",
    "found_at",
    "information_gain",
    "kullback_leibler",
    "length_distance",
    "log_density",
    "log_likelihood",
    "mean_performance",
    "merge_close",
    "multimatch",
    "nss",
    "performance_area",
    "probability_mismatch",
    "saccades",
    "scanmatch",
    "scanpath_ratio",
    "sequence_score",
    "similarity",
    "tfp_auc",
    "time_delay_embedding",
]
