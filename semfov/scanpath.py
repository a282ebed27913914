"""The record of an episode: where the gaze went, what was seen and what was believed."""

from dataclasses import dataclass

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections


@dataclass(frozen=True)
class Scanpath:
    """Fixations of one episode in order, with what was seen and believed at each.

    Attributes:
        grid: the cells of the image.
        classes: names of the classes, background first, in the order of the belief's components.
        target: index of the class that was searched for; None for exploration.
        cells: `(n,)`, fixated cells.
        fixations: `(n, 2)`, their centres as points `(x, y)`.
        detections: what was seen from each fixation, batches of one.
        beliefs: `(n, X·Y, K+1)`, Dirichlet parameters after each look.
        values: `(n, X·Y)`, acquisition values that the next fixation was chosen by.
        found: whether the search ended on its target.
        posterior: `(n, X·Y)`, probability of the target in each cell as the search believed it after each look; None
            for exploration. Learned target evidence holds a fixated cell for empty: the search would have ended there.
    """

    grid: Grid
    classes: tuple[str, ...]
    target: int | None
    cells: Tensor
    fixations: Tensor
    detections: tuple[Detections, ...]
    beliefs: Tensor
    values: Tensor
    found: bool
    posterior: Tensor | None = None

    def __len__(self) -> int:
        """Number of fixations, the start included."""
        return len(self.cells)

    @property
    def shifts(self) -> int:
        """Number of gaze shifts (saccades): fixations after the start."""
        return len(self) - 1
