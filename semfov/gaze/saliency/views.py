"""Views of a picture (the whole, its mirror image, windows), whose maps are joined on the picture's cells."""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.detection import Detections, Detector, FeatureMaps
from semfov.gaze.saliency.cells import cell_saliency
from semfov.gaze.saliency.fixation_density import FixationDensity, cells_of
from semfov.gaze.saliency.likeness import pooled
from semfov.io.tables import digits
from semfov.kinds import Quality

_WHOLE = 0.7  # share of the whole picture in the map, where there are windows, too
_SIDE = 2 / 3  # side of a window of a photograph, in sides of it
_RING = 4  # the number of windows around a panorama is a multiple, so that a quarter turn of it turns the map
_OVERLAP = 1.5  # least number of windows around a panorama that show a column, on average
_PROPORTION = 4 / 3  # width over height of a window of a panorama, that of the pictures of the fit
_GAIN = {"quick": 1.0, "best": 1.1}  # of the map: the mean of several is flatter than each of them
_EDGE = 1 / 4  # share of a window's side over which its weight falls to an edge inside the picture


class PictureView(NamedTuple):
    """A part of a picture at which a detector looks, in cells of the picture.

    Attributes:
        top: its first row.
        left: its first column; in a panorama it may reach past the last one, and continues at the first.
        rows: its number of rows.
        columns: its number of columns.
        mirrored: whether it is looked at in its mirror image.
    """

    top: int
    left: int
    rows: int
    columns: int
    mirrored: bool = False

    def covers(self, cells: tuple[int, int]) -> bool:
        """Whether the view shows the whole picture."""
        return (self.top, self.left, self.rows, self.columns) == (0, 0, *cells)

    @property
    def weight(self) -> Tensor:
        """Weight of each cell of the view, `(rows, columns)`: 1 in the middle, less towards the edges."""
        return _ramp(self.rows)[:, None] * _ramp(self.columns)


def _ramp(cells: int) -> Tensor:
    """Compute the weights of cells along a side."""
    place = torch.arange(cells) + 0.5
    from_edge = torch.minimum(place, cells - place)
    return (from_edge / max(cells * _EDGE, 1.0)).clamp(max=1)


def views_of(cells: tuple[int, int], quality: Quality, *, panorama: bool = False) -> list[PictureView]:
    """Make the views whose maps are joined to the map of a picture.

    A photograph is looked at as a whole, for `best` also in its mirror image and in four windows of two thirds of its
    sides. The windows on the right are mirrored, so that the mirror image of a photograph has the mirrored map. A
    panorama of 360° is looked at in windows of 4 : 3 around it, four or the multiple of four that a strip needs. They
    overlap all the way round. For `best` it is also looked at in their mirror images.

    Args:
        cells: rows and columns of cells of the picture.
        quality: `quick` or `best`.
        panorama: whether the left and the right edge of the picture meet.

    Returns:
        The views.

    >>> [len(views_of((39, 52), quality)) for quality in ("quick", "best")]
    [1, 6]
    >>> [len(views_of((rows, 52), "quick", panorama=True)) for rows in (26, 9)]
    [4, 8]
    """
    rows, columns = cells
    views = [*_windows_around(rows, columns)] if panorama else [PictureView(0, 0, rows, columns)]
    if quality == "quick":
        return views
    views += [view._replace(mirrored=True) for view in views]
    return views if panorama else [*views, *_windows(rows, columns)]


def _windows_around(rows: int, columns: int) -> Iterable[PictureView]:
    """List the windows around a panorama, at most one from each column."""
    width = min(columns, round(rows * _PROPORTION))
    count = min(columns, _RING * math.ceil(_OVERLAP * columns / width / _RING))
    for number in range(count):
        yield PictureView(0, number * columns // count, rows, width)


def _windows(rows: int, columns: int) -> Iterable[PictureView]:
    """List the windows at the corners of a photograph, the right ones mirrored."""
    height = max(1, round(rows * _SIDE))
    width = max(1, round(columns * _SIDE))
    for top in (0, rows - height):
        yield PictureView(top, 0, height, width)
        yield PictureView(top, columns - width, height, width, mirrored=True)


class PictureTerms(NamedTuple):
    """The terms of a model's log density for one picture.

    Attributes:
        terms: map and centre bias (`FixationDensity.terms`).
        unlikeness: distance of the picture from those of the fit; None where the model does not know them.
    """

    terms: dict[str, Tensor]
    unlikeness: float | None


def picture_terms(
    detector: Detector,
    image: Tensor,
    model: FixationDensity,
    *,
    quality: Quality = "quick",
    panorama: bool = False,
) -> PictureTerms:
    """Compute the terms of a picture from a pass of the detector for each of its views.

    Args:
        detector: the detector.
        image: `(3, H, W)`, RGB in [0, 1].
        model: a model that was fitted to the detector.
        quality: `quick` or `best`.
        panorama: whether the left and the right edge of the picture meet.

    Returns:
        The terms over the cells of the picture, `(1, rows, columns)`, and its distance from the pictures of the fit.
    """
    size = (int(image.shape[-2]), int(image.shape[-1]))
    cells = cells_of(size)
    views = views_of(cells, quality, panorama=panorama)
    maps: list[Tensor] = []
    distances: list[float] = []
    # Windows of a photograph are closer than the pictures of the fit are: the first view, the whole, tells.
    judged_views = len(views) if panorama else 1
    for number, view in enumerate(views):
        pixels = _pixels_of(view, image, cells)
        features = _features(detector, pixels, model)
        size_of_view = (int(pixels.shape[-2]), int(pixels.shape[-1]))
        maps.append(model.map(features, size_of_view)[0])
        if model.likeness is not None and number < judged_views:
            values = pooled(features, model.layers).to(model.likeness.mean)
            distances.append(float(model.likeness(values)[0]))
    unlikeness = digits(sum(distances) / len(distances)) if distances else None

    map = _GAIN[quality] * joined(maps, views, cells)
    centre = model.centre_bias(size)
    if panorama:
        centre = _same_in_all_directions(centre)
    return PictureTerms({"map": map[None], "centre bias": centre[None]}, unlikeness)


def _same_in_all_directions(centre: Tensor) -> Tensor:
    """Make the log bias `(rows, columns)` for people who turn round: no direction is the middle, but heights stay."""
    columns = centre.shape[1]
    return centre.logsumexp(1, keepdim=True).expand_as(centre) - math.log(columns)


def _features(detector: Detector, image: Tensor, model: FixationDensity) -> FeatureMaps:
    """Compute the layers of a detector that a model reads, from pixels `(3, H, W)`."""
    canvas, placement = detector.fit(image[None])
    maps = detector.feature_maps(canvas, [*model.layers])
    return FeatureMaps(maps, (canvas.shape[-1], canvas.shape[-2]), placement, Detections.empty(1, 0))


def _pixels_of(view: PictureView, image: Tensor, cells: tuple[int, int]) -> Tensor:
    """Cut a view out of a picture `(3, H, W)`, round the seam of a panorama, and mirror it if that is asked for."""
    if view.covers(cells):
        pixels = image
    else:
        height, width = image.shape[-2:]
        rows = _edges(view.top, view.rows, height / cells[0])
        columns = _edges(view.left, view.columns, width / cells[1])
        numbers = torch.arange(columns.start, columns.stop, device=image.device) % width
        pixels = image[:, rows, :].index_select(2, numbers)
    return pixels.flip(-1) if view.mirrored else pixels


def _edges(first: int, count: int, pixels: float) -> slice:
    """Find the pixels of cells along a side, at least one of them."""
    start = round(first * pixels)
    return slice(start, max(start + 1, round((first + count) * pixels)))


def joined(maps: Sequence[Tensor], views: Iterable[PictureView], cells: tuple[int, int]) -> Tensor:
    r"""Join the maps of views to one map over the cells of a picture.

    .. math:: m(u) = s \, \bar m_{\text{whole}}(u) + (1 - s) \frac{\sum_v w_v(u) \, m_v(u)}{\sum_v w_v(u)}

    The sums are over windows, whose weight w falls to their edges, so that none shows. Without
    windows s is 1, and without a view of the whole it is 0.

    Args:
        maps: the map of each view; of the whole picture on its cells, of a window of any size.
        views: the views.
        cells: rows and columns of cells of the picture.

    Returns:
        `(rows, columns)`.

    >>> views = views_of((26, 52), "quick", panorama=True)
    >>> joined([torch.ones(39, 52)] * 4, views, (26, 52)).unique()
    tensor([1.])
    """
    maps_of_whole: list[Tensor] = []
    weighted_sum = maps[0].new_zeros(cells)
    weight_sum = maps[0].new_zeros(cells)
    for map, view in zip(maps, views, strict=True):
        upright = map.flip(-1) if view.mirrored else map
        if view.covers(cells):
            maps_of_whole.append(upright)
            continue
        on_cells = cell_saliency(upright[None], view.columns, view.rows).view(view.rows, view.columns)
        weight = view.weight.to(map)
        rows = slice(view.top, view.top + view.rows)
        # Across the seam of a panorama the columns go on at its left edge.
        columns = (view.left + torch.arange(view.columns, device=map.device)) % cells[1]
        weighted_sum[rows].index_add_(1, columns, weight * on_cells)
        weight_sum[rows].index_add_(1, columns, weight)
    if len(maps_of_whole) == len(maps):
        return torch.stack(maps_of_whole).mean(0)
    of_windows = weighted_sum / weight_sum
    if not maps_of_whole:
        return of_windows
    of_whole = torch.stack(maps_of_whole).mean(0)
    return _WHOLE * of_whole + (1 - _WHOLE) * of_windows
