"""The looks of a fovea: fixations of cells, and closer looks at places of the photograph itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from semfov.belief import Grid
from semfov.detection.detections import Detections
from semfov.paths.look import Box, RecordedLook, cell_columns, finite_or_none


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class FoveaLook(RecordedLook):
    """One look of a fovea: a fixation, or a closer look, which enlarges a place of the photograph.

    Attributes:
        cell: the fixated cell, or the cell of the place.
        stages: seconds of the look by stage (`semfov.episode.STAGES`); empty if they are not known.
        is_closer: whether it is a closer look.
    """

    cell: int
    stages: Mapping[str, float] = field(default_factory=dict)
    is_closer: bool = False


class FoveaLooks:
    """Makes the looks of one episode of a fovea one after the other, complete and on one clock.

    Attributes:
        grid: the cells.
        looks: the looks so far.
    """

    def __init__(self, grid: Grid) -> None:
        self.grid = grid
        self.looks: list[FoveaLook] = []
        self._clock = 0.0  # sum of the seconds of all looks
        # The belief after the last fixation: of the target in each cell `(X·Y,)`, and in the picture.
        self._probability: Tensor | None = None
        self._presence: float | None = None

    def fixate(
        self,
        cell: int,
        point: Sequence[float],
        detections: Detections,
        stages: Mapping[str, float],
        value: float | None,
        probability: Tensor | None,
        presence: float | None,
    ) -> FoveaLook:
        """Add a fixation.

        Args:
            cell: the fixated cell.
            point: `(x, y)` in pixels.
            detections: what it shows, a batch of one.
            stages: seconds by stage; empty if they are not known.
            value: value for which the cell was chosen; None for the start.
            probability: `(X·Y,)`, probability of the target in each cell after it; None in an exploration.
            presence: probability that the picture holds the target after it; None where it is not known.

        Returns:
            The look.
        """
        x, y = point
        self._probability = probability
        self._presence = presence
        return self._add((x, y), _whole_picture(self.grid), detections, stages, value, cell, is_closer=False)

    def look_closely(
        self,
        cell: int,
        region: Sequence[float],
        detections: Detections,
        stages: Mapping[str, float],
        value: float,
    ) -> FoveaLook:
        """Add a closer look, which does not change the belief.

        Args:
            cell: cell of the place.
            region: `(x1, y1, x2, y2)` in pixels, the enlarged window.
            detections: what it shows, a batch of one.
            stages: seconds by stage; empty if they are not known.
            value: probability that the target is at the place, before the look.

        Returns:
            The look.
        """
        x1, y1, x2, y2 = region
        # Points have the centres of pixels at integers, and regions the edges: half a pixel lies between the two.
        middle = (x1 + x2 - 1) / 2, (y1 + y2 - 1) / 2
        return self._add(middle, (x1, y1, x2, y2), detections, stages, value, cell, is_closer=True)

    def _add(
        self,
        point: tuple[float, float],
        region: Box,
        detections: Detections,
        stages: Mapping[str, float],
        value: float | None,
        cell: int,
        *,
        is_closer: bool,
    ) -> FoveaLook:
        self._clock += sum(stages.values())
        look = FoveaLook(
            index=len(self.looks),
            fixation=point,
            region=region,
            detections=detections,
            seconds=self._clock if stages else None,
            value=finite_or_none(value),
            more={**cell_columns(self.grid, cell, self._probability), "presence": self._presence},
            cell=cell,
            stages=stages,
            is_closer=is_closer,
        )
        self.looks.append(look)
        return look


def _whole_picture(grid: Grid) -> Box:
    """Find the region of the whole picture, all of which a fovea shows, in whole pixels."""
    width, height = (int(side) for side in grid.extent)
    return 0.0, 0.0, float(width), float(height)


def moment_look(
    grid: Grid,
    number: int,
    cell: int,
    detections: Detections,
    probability: Tensor,
    stages: Mapping[str, float],
) -> FoveaLook:
    """Make the complete look at a frame of a stream, the only one of its moment.

    Args:
        grid: the cells.
        number: number of the frame.
        cell: the fixated cell, or the one that was looked at closely.
        detections: what it shows, a batch of one.
        probability: `(X·Y,)`, probability of the target, or of any object, in each cell after it.
        stages: seconds by stage.
    """
    x, y = grid.centres[cell].tolist()
    return FoveaLook(
        index=0,
        fixation=(x, y),
        region=_whole_picture(grid),
        detections=detections,
        seconds=sum(stages.values()),
        more={"frame": number, **cell_columns(grid, cell, probability)},
        cell=cell,
        stages=stages,
    )
