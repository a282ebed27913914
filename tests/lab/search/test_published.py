"""Figures of Ruarte et al. (2025), computed again from their files by their definitions."""

from itertools import combinations

import numpy as np
import pytest

from eval.human.search.trials import in_cells, read_searches, shift_found
from semfov import Grid
from semfov.data.fixations import by_picture
from semfov.metrics.scanpath import mean_performance, multimatch, performance_area, tfp_auc

pytestmark = pytest.mark.shared
SCREEN, GRID = (1680, 1050), Grid(32, 24, (1680, 1050))

AREA = {"humans": 0.802, "nnIBS": 0.460, "elm_final": 0.626}
MULTIMATCH = {
    "humans": (0.937, 0.760, 0.926, 0.906),
    "nnIBS": (0.918, 0.696, 0.914, 0.884),
    "elm_final": (0.923, 0.723, 0.921, 0.886),
}


@pytest.fixture(scope="module")
def searches(shared):
    folder = shared / "human/cocosearch18"
    found = {name: read_searches(folder / f"predicted/{name}.json", SCREEN) for name in ("nnIBS", "elm_final", "sIBS")}
    return {"humans": read_searches(folder / "human_scanpaths", SCREEN), **found}


def shifts(searches):
    return [shift_found(each, 10) for each in searches]


@pytest.mark.parametrize("name", AREA)
def test_area_under_cumulative_performance_matches_the_published_value(searches, name):
    curve = mean_performance(shifts(searches[name]), [each.subject for each in searches[name]], 9)
    assert performance_area(curve) == pytest.approx(AREA[name], abs=5e-4)


@pytest.mark.parametrize("name", ["humans", "nnIBS", "elm_final", "sIBS"])
def test_tfp_auc_is_the_definition_by_loops(searches, name):
    """Yang et al. (2020): for 1 to 7 fixations, the mean over categories of the share of their searches that are done.

    Ruarte et al. have no value for these files. The definition counts the fixations of each search one by one.
    """
    categories = {}
    for each in searches[name]:
        needed = next((n for n, (x, y) in enumerate(each.points + 0.5, 1) if inside(each.box, x, y)), 99)
        needed = needed if each.found is None else len(each) if each.found else 99
        categories.setdefault(each.target, []).append(needed)
    expected = 0.0
    for fixations in range(1, 8):
        shares = [sum(needed <= fixations for needed in some) / len(some) for some in categories.values()]
        expected += sum(shares) / len(shares)
    found = [shift_found(each, 10**6) for each in searches[name]]
    assert tfp_auc(found, [each.target for each in searches[name]]) == pytest.approx(expected, abs=1e-9)


def inside(box, x, y):
    return box[0] <= x <= box[2] and box[1] <= y <= box[3]


def similarities(pairs):
    """Mean of four MultiMatch similarities by picture, over pairs in which both searches found the target."""
    found = {}
    for a, b in pairs:
        if a.found and b.found:
            figures = multimatch(in_cells(a, GRID), in_cells(b, GRID), (32, 24))
            found.setdefault(a.picture, []).append(figures[:4])
    means = {name: np.nanmean(rows, axis=0) for name, rows in found.items() if np.isfinite(rows).any()}
    return {name: row for name, row in means.items() if np.isfinite(row).all()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nnIBS", "elm_final"])
def test_multimatch_similarities_match_the_published_values(searches, name):
    """Means over the pictures that have similarities both between model and people and among people."""
    people = by_picture(searches["humans"])
    model = similarities((a, b) for a in searches[name] for b in people[a.picture])
    themselves = similarities(pair for picture in model for pair in combinations(people[picture], 2))
    rows = [model[picture] for picture in themselves]
    np.testing.assert_allclose(np.mean(rows, axis=0), MULTIMATCH[name], atol=0.001)
    if name == "nnIBS":
        # The figures for people depend on the model; the published ones are those for nnIBS.
        np.testing.assert_allclose(np.mean(list(themselves.values()), axis=0), MULTIMATCH["humans"], atol=0.001)
