"""A predicted density of fixations beside the fixations of people in the same picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from semfov.data.fixations.record import Fixations, FixationValues
from semfov.data.fixations.suspicions import warn_outside
from semfov.errors import check
from semfov.metrics.scanpath.maps import auc, auc_judd, correlation, kullback_leibler, log_likelihood, nss, similarity
from semfov.paths.gaze import GazePrediction

_BLUR = 0.03


def _people_density(points: FixationValues, size: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float64]:
    """A map of `(rows, columns)`, a Gaussian of 3 % of its longer side around each point; points `(n, 2)`."""
    rows, columns = (np.arange(side) for side in shape)
    x, y = ((points + 0.5) * (np.array(shape[::-1]) / np.array(size)) - 0.5).T
    width = 2 * (_BLUR * max(shape)) ** 2
    across = np.exp(-((columns[:, None] - x) ** 2) / width)
    down = np.exp(-((rows[:, None] - y) ** 2) / width)
    return np.asarray(down @ across.T)


def compare_density(prediction: GazePrediction, people: Sequence[Fixations]) -> dict[str, float]:
    """Measures of a density against all fixations of people but their first ones, and against their blurred density."""
    records = warn_outside("people", [each.resized(prediction.size) for each in people])
    points = np.concatenate([each.points[1:][each.inside[1:]] for each in records])
    check(len(points) > 0, "people", "fixations inside the picture after the first of each person", "none")
    cells = prediction.cells.double().numpy()
    ratio = np.array(cells.shape[::-1]) / np.array(prediction.size)
    x, y = ((points + 0.5) * ratio - 0.5).T
    theirs = _people_density(points, prediction.size, cells.shape)
    return {
        "NSS": float(nss(cells, x, y).mean()),
        "AUC": float(auc(cells, x, y).mean()),
        "AUC Judd": auc_judd(cells, x, y),
        "log likelihood": float(log_likelihood(np.log(cells), x, y).mean()),
        "CC": float(correlation(cells, theirs)),
        "SIM": float(similarity(cells, theirs)),
        "KL": float(kullback_leibler(theirs, cells)),
    }
