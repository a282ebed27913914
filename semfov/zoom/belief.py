"""What looks at a picture say of where closer looks pay."""

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.zoom.evidence import STEPS, GlimpseEvidence, pool, pool_all
from semfov.zoom.gist import Gist
from semfov.zoom.glances import Glance, Window
from semfov.zoom.lattice import Lattice

_LEFT = 0.05  # of what was expected in the middle of a window stays after it was looked at as closely


class ZoomBelief:
    """What is expected of every window of a picture, for one class.

    A cell goes by the closest look at it. It keeps five numbers, 24 bytes: the level of that look, how many objects
    centred in it are expected to be found one, two and three octaves closer, and what is left to see in it. All classes
    are kept for looked-at windows alone, at most 32 × 32 cells of each. A picture of 20,000 × 15,000 px has 49,152
    cells: 1.2 MB, and for 80 classes at most 0.41 MB for each look.

    Args:
        lattice: of the picture.
        evidence: learned, by magnification.
        target: class 1..K, or 0 for any.
    """

    def __init__(self, lattice: Lattice, evidence: GlimpseEvidence, target: int) -> None:
        self.lattice, self.evidence, self.target = lattice, evidence, target
        shape = lattice.rows, lattice.columns
        self.rate = torch.zeros(STEPS, *shape)
        self.source = torch.full(shape, -1)
        self.left = torch.ones(shape)
        self.gists: list[Gist] = []
        self._odds: dict[int, Tensor] = {}
        self._told: dict[Window, float] = {}

    def forget(self) -> None:
        """Compute odds anew: what was looked at has changed."""
        self._odds.clear()

    def add(self, glance: Glance) -> None:
        """Take account of a look."""
        window, look = glance.window, glance.gist
        self.forget()
        if look is not None:
            self._spread(look)
            self.gists.append(look)
            self._told.clear()
        else:
            self.discount(window)

    def discount(self, window: Window) -> None:
        """Expect no more of what a window shows well: it was looked at, or is about to be."""
        x1, y1, x2, y2 = window.cells
        rows, columns = slice(max(y1, 0), max(y2, 0)), slice(max(x1, 0), max(x2, 0))
        across, down = self.evidence.taper(x2 - x1).detach(), self.evidence.taper(y2 - y1).detach()
        seen = down[max(-y1, 0) :, None] * across[None, max(-x1, 0) :]
        left = self.left[rows, columns]
        share = 1 - (1 - _LEFT) * seen[: left.shape[0], : left.shape[1]]
        self.left[rows, columns] = torch.minimum(left, share) if window.within is None else left * _LEFT
        self.forget()

    def _spread(self, look: Gist) -> None:
        """Rates of a look on the cells that were not looked at as closely before."""
        rows = min(look.scores.shape[0] * look.scale, self.lattice.rows - look.first[1])
        columns = min(look.scores.shape[1] * look.scale, self.lattice.columns - look.first[0])
        at = (slice(look.first[1], look.first[1] + rows), slice(look.first[0], look.first[0] + columns))
        before = None
        if look.level > 0:
            before = before_of(self.rate[:, *at], self.source[at], look)
        with torch.no_grad():
            logs = self.evidence.rates(look, torch.tensor([self.target]), None if before is None else before[None])[0]
        cells = logs.exp() / look.scale**2
        cells = cells.repeat_interleave(look.scale, -1).repeat_interleave(look.scale, -2)[:, :rows, :columns]
        newer = self.source[at] < look.level
        self.rate[:, *at] = torch.where(newer, cells, self.rate[:, *at])
        self.source[at] = torch.where(newer, look.level, self.source[at])

    def expected(self, level: int) -> Tensor:
        """Objects that looks of a level are expected to find, cell by cell, `(rows, columns)`."""
        steps = level - self.source
        told = self.rate.gather(0, (steps - 1).clamp(0, STEPS - 1)[None])[0]
        return told * (steps >= 1) * (steps <= STEPS) * self.left

    def finds(self, level: int) -> Tensor:
        """Objects that each window of a level is expected to find, `(down, across)`."""
        span = self.lattice.span(level)
        weight = self.evidence.taper(span).detach()
        image = self.expected(level)[None, None]
        wide, high = (max(span - n, 0) for n in (self.lattice.columns, self.lattice.rows))
        image = F.pad(image, (0, wide, 0, high))
        across = F.conv2d(image, weight[None, None, None])
        return F.conv2d(across, weight[None, None, :, None])[0, 0]

    def odds(self, level: int) -> Tensor:
        """Log odds that each window of a level shows the class, `(down, across)`; -inf where nothing is known."""
        if level in self._odds:
            return self._odds[level]
        across, down = self.lattice.places(level)
        result = torch.full((down, across), -torch.inf)
        for look in sorted(self.gists, key=lambda gist: gist.level):
            steps, span = level - look.level, self.lattice.span(level) // look.scale
            if not 1 <= steps <= STEPS or span < 1:
                continue
            left, top = look.first
            shape = look.scores.shape[:2]
            high, wide = (max(n - span, 0) + 1 for n in shape)
            scores = look.scores * self._left_of(look)[..., None]
            pooled, summary = pool_all(scores, span)
            row = (top + torch.arange(high) * look.scale).clamp(max=down - 1)
            column = (left + torch.arange(wide) * look.scale).clamp(max=across - 1)
            known = result[row[:, None], column]
            before = None if look.level == 0 else known.reshape(-1, 1).nan_to_num(neginf=-4.0)
            with torch.no_grad():
                told = self.evidence.presence(pooled, summary, torch.full((high * wide,), steps), self.target, before)
            table = told.view(high, wide)
            if look.scale > 1:
                # Windows between the places that a coarse look tells go by the place before them.
                table = table.repeat_interleave(look.scale, 0).repeat_interleave(look.scale, 1)
                table = table[: down - top, : across - left]
                result[top : top + table.shape[0], left : left + table.shape[1]] = table
            else:
                result[row[:, None], column] = table
        self._odds[level] = result
        return result

    def _left_of(self, look: Gist) -> Tensor:
        """What is left to see in the cells of a look, `(rows, columns)`: 0 where they were looked at closely."""
        rows, columns = look.scores.shape[:2]
        high, wide = rows * look.scale, columns * look.scale
        part = self.left[look.first[1] : look.first[1] + high, look.first[0] : look.first[0] + wide]
        part = F.pad(part[None, None], (0, wide - part.shape[1], 0, high - part.shape[0]), value=1.0)
        return F.avg_pool2d(part, look.scale)[0, 0]

    def odds_of(self, window: Window) -> float:
        """Log odds that a window shows the class, which need not be one of the lattice."""
        if window in self._told:
            return self._told[window]
        value: Tensor | None = None
        for look in sorted(self.gists, key=lambda gist: gist.level):
            steps = window.level - look.level
            x1, y1, x2, y2 = window.cells
            left, top = look.first
            inside = x1 >= left and y1 >= top and x2 <= left + look.scores.shape[1] * look.scale
            inside = inside and y2 <= top + look.scores.shape[0] * look.scale
            if not (inside or look.level == 0) or not 1 <= steps <= STEPS:
                continue
            box = (
                (x1 - left) // look.scale,
                (y1 - top) // look.scale,
                max(-(-(x2 - left) // look.scale), (x1 - left) // look.scale + 1),
                max(-(-(y2 - top) // look.scale), (y1 - top) // look.scale + 1),
            )
            pooled, summary = pool(look.scores, box)
            with torch.no_grad():
                value = self.evidence.presence(
                    pooled[None], summary[None], torch.tensor([steps]), self.target,
                    None if value is None or look.level == 0 else value.view(1, 1),
                )  # fmt: skip
        self._told[window] = float("-inf") if value is None else float(value)
        return self._told[window]


def before_of(rate: Tensor, source: Tensor, look: Gist) -> Tensor:
    """Logarithm of the rates that were expected of looks one octave closer than a look, in its cells.

    Args:
        rate: `(3, rows, columns)` of the lattice's cells that the look shows.
        source: `(rows, columns)`, level of the look that told each.
        look: the new look.
    """
    steps = (look.level + 1 - source).clamp(1, STEPS)
    told = rate.gather(0, (steps - 1)[None])[0]
    rows, columns = look.scores.shape[:2]
    told = F.pad(told[None, None], (0, columns * look.scale - told.shape[1], 0, rows * look.scale - told.shape[0]))
    return (F.avg_pool2d(told, look.scale)[0, 0] * look.scale**2 + 1e-6).log()
