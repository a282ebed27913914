"""The map of a picture from several views, beside loops over cells."""

import numpy as np
import pytest
import torch

from semfov.gaze.saliency import FixationDensity
from semfov.gaze.saliency.views import PictureView, joined, picture_terms, views_of
from tests.small import Shown, rand


def falling(cells):
    """Weights along a side: up over the first quarter, 1, and down over the last."""
    return [min((i + 0.5) / (cells / 4), (cells - i - 0.5) / (cells / 4), 1) for i in range(cells)]


def test_maps_are_joined_by_weights_that_fall_to_the_edges():
    """Twin: a loop over the cells of maps that have the cells of their views already."""
    cells = (6, 8)
    views = [
        PictureView(0, 0, 6, 8),
        PictureView(0, 0, 6, 8, mirrored=True),
        PictureView(0, 0, 4, 5),
        PictureView(2, 0, 4, 5, mirrored=True),
        PictureView(0, 3, 4, 5),
        PictureView(2, 3, 4, 5),
    ]
    maps = [rand(view.rows, view.columns) for view in views]
    values = np.zeros(cells)
    weights = np.zeros(cells)
    for map, view in zip(maps[2:], views[2:], strict=True):
        for row in range(view.rows):
            for column in range(view.columns):
                source = view.columns - 1 - column if view.mirrored else column
                weight = falling(view.rows)[row] * falling(view.columns)[column]
                values[view.top + row, view.left + column] += weight * float(map[row, source])
                weights[view.top + row, view.left + column] += weight
    whole = (maps[0].numpy() + maps[1].numpy()[:, ::-1]) / 2
    expected = 0.7 * whole + 0.3 * values / weights
    np.testing.assert_allclose(joined(maps, views, cells).numpy(), expected, rtol=1e-5)


@pytest.mark.parametrize("cells", [(39, 52), (52, 39), (1, 52), (52, 2), (26, 52)])
@pytest.mark.parametrize("panorama", [False, True])
def test_views_show_every_cell(cells, panorama):
    for quality in ("quick", "best"):
        views = views_of(cells, quality, panorama=panorama and cells == (26, 52))
        seen = torch.zeros(cells)
        for view in views:
            columns = (view.left + torch.arange(view.columns)) % cells[1]
            seen[view.top : view.top + view.rows, columns] += 1
        assert int(seen.min()) >= 1
        maps = [torch.ones(cells) if view.covers(cells) else torch.ones(3, 4) for view in views]
        torch.testing.assert_close(joined(maps, views, cells), torch.ones(cells))


@pytest.mark.parametrize("rows", range(1, 36))
def test_the_windows_around_a_panorama_overlap_all_the_way_round(rows):
    views = views_of((rows, 52), "quick", panorama=True)
    most = torch.zeros(52)
    for view in views:
        columns = (view.left + torch.arange(view.columns)) % 52
        most[columns] = most[columns].maximum(torch.tensor(falling(view.columns)))
    assert float(most.min()) > 0.39  # an end of a window of five columns has 0.4
    assert {(view.left + 13) % 52 for view in views} == {view.left for view in views}
    assert len({view.left for view in views}) == len(views)
    assert joined([torch.ones(3, 4)] * len(views), views, (rows, 52)).eq(1).all()


def test_the_mirror_image_has_the_mirrored_map():
    torch.manual_seed(0)
    detector = Shown("colours", ("none",), (80, 60), stride=4).eval()
    model = FixationDensity({"backbone8": 3}).eval().requires_grad_(False)
    image = rand(3, 120, 156).float()
    upright = picture_terms(detector, image, model, quality="best").terms["map"]
    mirrored = picture_terms(detector, image.flip(-1), model, quality="best").terms["map"]
    torch.testing.assert_close(mirrored, upright.flip(-1), rtol=1e-4, atol=1e-5)
    once = picture_terms(detector, image, model).terms["map"]
    assert torch.equal(once, model.map(detector.features(image[None]), (120, 156)))
    assert not once.allclose(upright)
