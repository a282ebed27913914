"""Where earlier looks lie in the present frame of a moving camera.

    frame t0:  window ▢ with boxes ──── motion since t0 ────►  frame t:  window ▢ and boxes, moved and scaled,
                                                                         the same scores, a map of hints resampled

A look is carried from the frame in which it was taken, by the motion since then, so that nothing is resampled twice.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.motion import Motion, moved_boxes
from semfov.observation.matching import inside_frame
from semfov.zoom.hints import Gist
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, nearest_cells


def carried(looks: Sequence[WindowLook], motions: Sequence[Motion], lattice: Lattice) -> list[WindowLook]:
    """Transform the windows and boxes of looks to another frame.

    Args:
        looks: the looks, as they were taken.
        motions: for each, the map from pixels of the frame in which it was taken to those of the other frame.
        lattice: lattice of the frames.

    Returns:
        What the looks show of the other frame, in its pixels: detections that have left it are left out. Windows may
        reach beyond the frame, and are none of the lattice's any more.
    """
    if not looks:
        return []
    # The windows and the boxes of all looks are moved together: one at a time costs more than the detector saves.
    regions = torch.tensor([look.window.region(lattice) for look in looks], dtype=torch.float64)
    boxes = torch.cat([look.detections.boxes[0] for look in looks])
    counts = [look.detections.boxes.shape[1] for look in looks]
    look_of_box = np.repeat(np.arange(len(looks)), counts)
    matrix_of_look = np.stack([motion.matrix for motion in motions])
    matrices = torch.from_numpy(np.concatenate([matrix_of_look, matrix_of_look[look_of_box]]))
    moved, scales = moved_boxes(matrices, torch.cat([regions, boxes.double()]))
    moved_regions, moved_detections = moved.split([len(looks), len(boxes)])
    regions_in_frame = moved_regions.tolist()
    scale_of_look = scales[: len(looks)].tolist()
    boxes_in_frame = moved_detections.to(boxes.dtype)
    in_view = inside_frame(boxes_in_frame, lattice.size).split(counts)
    boxes_of_looks = boxes_in_frame.split(counts)
    carried_looks = []
    for number, look in enumerate(looks):
        window = _window_at(look.window, regions_in_frame[number], scale_of_look[number], lattice)
        detections = replace(look.detections, boxes=boxes_of_looks[number][None])
        gist = None if look.gist is None else _carried_gist(look.gist, motions[number], lattice)
        carried_look = replace(look, window=window, detections=detections, gist=gist)
        carried_looks.append(_without_what_left(carried_look, in_view[number]))
    return carried_looks


def _without_what_left(look: WindowLook, in_view: Tensor) -> WindowLook:
    """Leave out the detections of a look that have left the frame.

    Args:
        look: the look.
        in_view: `(L,)` boolean, which of its detections the frame shows.

    Returns:
        The look. Its strongest hints may have been those of what has left, so that what remains tells what it shows.
    """
    if bool(in_view.all()):
        return look
    detections = look.detections.take(in_view)
    show = look.show.minimum(detections.scores[0, :, 1:].amax(0)) if bool(in_view.any()) else look.show * 0
    return replace(look, detections=detections, cut=look.cut[in_view], show=show)


def share_shown(window: Window, lattice: Lattice) -> float:
    """Compute the share of the frame that a window shows.

    Args:
        window: the window, which may lie beyond the frame.
        lattice: lattice of the frame.

    Returns:
        From 0 to 1.
    """
    return _area(window.region(lattice)) / math.prod(lattice.size)


def share_left(window: Window, lattice: Lattice) -> float:
    """Compute the share of a carried window that the frame still shows.

    Args:
        window: the window, which may lie beyond the frame.
        lattice: lattice of the frame.

    Returns:
        From 0 to 1.
    """
    assert window.within is not None
    return _area(window.region(lattice)) / _area(window.within)


def _area(box: tuple[float, float, float, float]) -> float:
    x1, y1, x2, y2 = box
    return max(x2 - x1, 0.0) * max(y2 - y1, 0.0)


def _window_at(window: Window, region: Sequence[float], scale: float, lattice: Lattice) -> Window:
    """Make the window of another frame that shows a region `x1 y1 x2 y2`, whose pixels are scaled."""
    x1, y1, x2, y2 = region
    # Where a pixel of the look is several of this frame, each of these has fewer canvas pixels.
    fixation = (x1 + x2) / 2 - 0.5, (y1 + y2) / 2 - 0.5, window.fixation[2] / scale
    box = x1, y1, x2, y2
    return Window(fixation, window.level, nearest_cells(lattice, box), box)


def _carried_gist(gist: Gist, motion: Motion, lattice: Lattice) -> Gist | None:
    """Carry hints to the cells of another frame, each from the nearest cell of the look; None for no cell.

    Hints of a look at the whole frame fill the lattice: what enters at a border is expected to be like that border.
    """
    rows, columns = gist.scores.shape[:2]
    first = np.array(gist.first)
    is_overview = gist.level == 0
    squares = (first, np.array([columns, rows])) if is_overview else _moved_squares(gist, motion, lattice)
    if squares is None:
        return None
    new_first, counts = squares
    pitch = np.array(lattice.pitch)
    centres = torch.from_numpy((new_first + (_squares(*counts) + 0.5) * gist.scale) * pitch)
    # Where the centres of the new squares were in the frame of the look, in its squares.
    back = motion.inverse()
    origins = back.points(centres).numpy()
    place = np.floor((origins / pitch - first) / gist.scale).astype(np.intp)
    nearest = place.clip(0, (columns - 1, rows - 1))
    resampled = _resampled(gist, (int(new_first[0]), int(new_first[1])), nearest)
    if is_overview:
        return resampled
    # Beyond what the look showed it says nothing.
    is_inside = torch.from_numpy((place == nearest).all(-1))
    is_shown = is_inside & back.is_ahead(centres)
    if bool(is_shown.all()):
        return resampled
    return replace(
        resampled,
        scores=resampled.scores * is_shown[..., None],
        size=resampled.size * is_shown,
        found=resampled.found & is_shown[..., None],
    )


def _squares(columns: int, rows: int) -> NDArray[np.float64]:
    """List column and row of squares, `(rows, columns, 2)`."""
    squares = np.empty((rows, columns, 2))
    squares[..., 0] = np.arange(columns)
    squares[..., 1] = np.arange(rows)[:, None]
    return squares


def _resampled(gist: Gist, first: tuple[int, int], square: NDArray[np.intp]) -> Gist:
    """Make hints that begin at another cell, of which each has those of a square `(..., 2)`, column and row."""
    columns = gist.scores.shape[1]
    # Numbers of whole rows are read in a third of the time that pairs of indices take.
    numbers = torch.from_numpy(square[..., 1] * columns + square[..., 0])

    def read(values: Tensor) -> Tensor:
        return values.flatten(0, 1).index_select(0, numbers.flatten()).unflatten(0, numbers.shape)

    return replace(gist, first=first, scores=read(gist.scores), size=read(gist.size), found=read(gist.found))


def _moved_squares(gist: Gist, motion: Motion, lattice: Lattice) -> tuple[NDArray[np.int_], NDArray[np.int_]] | None:
    """Find the squares of cells of the lattice to which the hints of a look at a part of the frame are moved.

    Args:
        gist: the hints, by squares of `scale` cells.
        motion: from the frame of the look to the present one.
        lattice: lattice of the frames.

    Returns:
        First cell `(column, row)`, and number of squares across and down; None if none is in the frame.
    """
    pitch = np.array(lattice.pitch)
    corner = torch.from_numpy(np.array(gist.first) * pitch)
    if not motion.is_ahead(corner):
        return None
    rows, columns = gist.scores.shape[:2]
    moved_first = np.rint(motion.points(corner[None])[0].numpy() / pitch).astype(int)
    moved_end = moved_first + gist.scale * np.array([columns, rows])
    first = moved_first.clip(0)
    end = np.minimum(moved_end, (lattice.columns, lattice.rows))
    counts = (end - first) // gist.scale
    return (first, counts) if counts.min() > 0 else None
