"""Feature maps of all looks of a fovea so far, joined: each place from the look with the closest fixation."""

from dataclasses import replace

import torch
from torch import Tensor

from semfov.detection.feature_maps import FeatureMaps
from semfov.errors import check, check_shape


def features_so_far(views: FeatureMaps, fixations: Tensor, scanpath: Tensor) -> FeatureMaps:
    r"""Join the feature maps of foveated views: each place is taken from the view with the closest fixation.

    .. math:: \Phi(u) = \phi_{i^*}(u), \quad i^* = \arg\min_{i \le n} \lVert u - f_i \rVert

    A `FixationDensity` of these maps knows only what the eye has seen. Each fixation of a scanpath takes the view that
    was fixated nearest to it, so views from the cells of a grid serve all scanpaths.

    Args:
        views: `Detector.features` of V foveated views of one picture, maps `(V, C, h, w)`.
        fixations: `(V, 2)`, where each view was fixated, in pixels of the picture.
        scanpath: `(B, n, 2)`, fixations so far in pixels of the picture, NaN before a shorter path.

    Returns:
        Maps `(B, C, h, w)`, with the placement of `views`.

    Raises:
        InputError: the shapes do not fit together, or a scanpath has no fixation.

    >>> from semfov.detection import Detections, Placement
    >>> nothing = Detections(torch.zeros(2, 0, 4), torch.zeros(2, 0, 1), torch.zeros(2, 0, dtype=torch.bool))
    >>> maps = {"backbone8": torch.tensor([1.0, 2.0]).view(2, 1, 1, 1).expand(2, 1, 1, 4)}
    >>> views = FeatureMaps(maps, (40, 10), Placement((40, 10), (1.0, 1.0), (0, 0)), nothing)
    >>> ends = torch.tensor([[5.0, 5.0], [35.0, 5.0]])
    >>> features_so_far(views, ends, ends[None]).maps["backbone8"].flatten().tolist()
    [1.0, 1.0, 2.0, 2.0]
    """
    check_shape(fixations, "fixations", len(next(iter(views.maps.values()))), 2)
    check_shape(scanpath, "scanpath", None, None, 2)
    fixated = ~scanpath[..., 0].isnan()
    check(bool(fixated.any(-1).all()), "scanpath", "at least one fixation in each", "none")

    # A distance to NaN would be NaN: what is not fixated is put at 0, and ruled out below.
    points = torch.where(fixated[..., None], scanpath, 0.0).to(fixations)
    nearest_view = torch.cdist(points, fixations.expand(len(points), -1, -1)).argmin(-1)
    view_fixations = fixations[nearest_view]

    joined = {}
    for name, maps in views.maps.items():
        height, width = maps.shape[-2:]
        pixels = _pixels_on_picture(views, height, width, fixations)
        distance = torch.cdist(pixels.expand(len(points), -1, -1), view_fixations)  # (B, pixels, n)
        closest_look = distance.masked_fill(~fixated[:, None], torch.inf).argmin(-1)
        closest_view = nearest_view.gather(1, closest_look)  # (B, pixels)
        pixel = torch.arange(height * width, device=closest_view.device)
        features_by_pixel = maps.flatten(2).transpose(1, 2)  # (views, pixels, C)
        features = features_by_pixel[closest_view, pixel]
        joined[name] = features.transpose(1, 2).unflatten(2, (height, width))
    return replace(views, maps=joined)


def _pixels_on_picture(views: FeatureMaps, height: int, width: int, like: Tensor) -> Tensor:
    """Compute where the pixels of a feature map lie in the picture.

    Args:
        views: the feature maps, whose canvas and placement say where the picture is.
        height: rows of the map.
        width: columns of the map.
        like: tensor of the dtype and device wanted.

    Returns:
        Centres of the pixels row by row, `(height · width, 2)`, in pixels of the picture.
    """
    canvas_width, canvas_height = views.canvas
    offset_x, offset_y = views.placement.offset
    scale_x, scale_y = views.placement.scale
    columns = (torch.arange(width).to(like) + 0.5) * (canvas_width / width)  # in canvas pixels
    rows = (torch.arange(height).to(like) + 0.5) * (canvas_height / height)
    x = (columns - offset_x) / scale_x
    y = (rows - offset_y) / scale_y
    centres = torch.stack([x.expand(height, -1), y[:, None].expand(-1, width)], -1)
    return centres.flatten(0, 1) - 0.5
