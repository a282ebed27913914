"""Measures of scanpaths: people compared with people, and models compared with people.

Fixations are arrays of points in any one unit. Maps are arrays `(H, W)` whose pixel centres are at integers.
Definitions differ between groups, and each function names the group whose definition it computes. Functions on
sequences need `pip install semfov[human]`.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from semfov.human.scanpath import (
        BesidePeople,
        MultiMatch,
        ScanpathComparison,
        auc,
        auc_borji,
        auc_judd,
        auc_shuffled,
        cell_labels,
        cluster_labels,
        compare_scanpath,
        correlation,
        direction_distance,
        dynamic_time_warping,
        edit_distance,
        found_at,
        information_gain,
        kullback_leibler,
        length_distance,
        log_density,
        log_likelihood,
        mean_performance,
        merge_close,
        multimatch,
        nss,
        performance_area,
        probability_mismatch,
        saccades,
        scanmatch,
        scanpath_ratio,
        sequence_score,
        similarity,
        tfp_auc,
        time_delay_embedding,
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


def __getattr__(name: str) -> object:
    """Import a measure when it is first asked for."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    import semfov.human.scanpath

    return getattr(semfov.human.scanpath, name)
