"""Comparison of where people look in two drafts of a picture."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from semfov.errors import check, checked_keywords, type_of
from semfov.paths.areas import Area, AreasLike, percent, read_areas
from semfov.paths.gaze import GazePrediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class AreaShares(NamedTuple):
    """Shares of the fixations in an area of two drafts.

    Attributes:
        first: share in the first draft.
        second: share in the second one.
    """

    first: float
    second: float

    @property
    def difference(self) -> float:
        """Share in the second draft less that in the first one."""
        return self.second - self.first


@dataclass(frozen=True, eq=False)
class Drafts:
    """Where people look in two drafts.

    Attributes:
        first: prediction for the first draft.
        second: prediction for the second one.

    Example::

        drafts = Drafts(agent.gaze("before.png"), agent.gaze("after.png"))
        drafts.shares({"logo": (10, 20, 200, 80)})["logo"].difference
        drafts.plot()

    Raises:
        InputError: a draft is no prediction.
    """

    first: GazePrediction
    second: GazePrediction

    def __post_init__(self) -> None:
        for draft, argument in ((self.first, "first"), (self.second, "second")):
            is_prediction = isinstance(draft, GazePrediction)
            check(is_prediction, argument, "a prediction, agent.gaze(picture)", type_of(draft))

    @property
    def names(self) -> tuple[str, str]:
        """Names of the drafts: of their files, by their paths if these are alike, and counted if the paths are, too."""
        name = self.first.name
        if name != self.second.name:
            return name, self.second.name
        source = self.first.source
        other = self.second.source
        if source is not None and other is not None and source != other:
            return source, other
        return f"{name} (first)", f"{name} (second)"

    @property
    def difference(self) -> Tensor | None:
        """Density of the second draft less that of the first, `(rows, columns)`; None if proportions differ."""
        if self.first.cells.shape != self.second.cells.shape:
            return None
        return self.second.cells - self.first.cells

    @property
    def moved(self) -> float | None:
        """Share of the fixations that are elsewhere in the second draft; None if proportions differ."""
        return None if self.difference is None else float(self.difference.clamp(min=0).sum())

    def shares(self, areas: AreasLike) -> dict[str, AreaShares]:
        """Compute the shares of the fixations in areas of both drafts.

        Args:
            areas: areas in pixels of each draft, as for `GazePrediction.share`. If an area moves between the drafts,
                give its box in each of them, by the names of the drafts (`names`).

        Returns:
            The shares by the name of the area.

        Raises:
            InputError: an area has another form or reaches out of a draft, or the drafts have other areas.
            DataError: the file cannot be read.
        """
        in_first, in_second = self.areas(areas)
        first = self.first.share(in_first)
        second = self.second.share(in_second)
        return {name: AreaShares(first[name], second[name]) for name in first}

    def areas(self, areas: AreasLike) -> tuple[dict[str, Area], dict[str, Area]]:
        """Read areas of interest in each draft, and check that they lie in it.

        Args:
            areas: as for `shares`.

        Returns:
            The areas by name, in the first and in the second draft.
        """
        first, second = (
            read_areas(areas, draft.size, [name, draft.name, draft.source or draft.name])
            for draft, name in zip((self.first, self.second), self.names, strict=True)
        )
        check(first.keys() == second.keys(), "areas", f"the same areas in both drafts: {', '.join(first)}", [*second])
        return first, second

    def describe(self, areas: AreasLike | None = None) -> str:
        """Describe what differs, in a line for each area, and say so if all areas are at the same place in both drafts.

        Args:
            areas: as for `shares`.

        Returns:
            The lines.
        """
        first, second = self.names
        lines = [f"{first} and {second}: {self._moved()}"]
        if areas is None:
            return lines[0]
        for name, shares in self.shares(areas).items():
            lines.append(f"  {name}: {percent(shares.first)} and {percent(shares.second)} of all fixations")
        place = self.same_place(areas)
        return "\n".join(lines if place is None else [*lines, f"  {place}"])

    def same_place(self, areas: AreasLike) -> str | None:
        """Say that all areas are at the same place in both drafts; None if they are not.

        Args:
            areas: as for `shares`.

        Returns:
            A sentence or None.
        """
        in_first, in_second = self.areas(areas)
        if in_first != in_second or self.first.size != self.second.size:
            return None
        first, second = self.names
        return f"Areas are at the same place in both drafts. What moves needs boxes for {first} and for {second}."

    def _moved(self) -> str:
        """Say how many fixations move."""
        if self.moved is None:
            return "their proportions differ, so only areas can be compared"
        return f"{percent(self.moved)} of the fixations are elsewhere in the second"

    def plot(self, *, areas: AreasLike | None = None) -> Figure:
        """Draw both maps on one scale, and what differs.

        Args:
            areas: areas to draw with their shares, as for `shares`.

        Returns:
            The figure.
        """
        from semfov.viz.drafts import plot_drafts

        return plot_drafts(self, areas=areas)

    @checked_keywords
    def report(self, path: str | PathLike[str], *, title: str | None = None, areas: AreasLike | None = None) -> Path:
        """Write an HTML page with both maps on one scale, what differs, and the shares of areas.

        Args:
            path: the file.
            title: heading of the page; None says that two drafts are compared.
            areas: as for `shares`.

        Returns:
            The path.

        Raises:
            InputError: the file does not end in `.html` or `.htm`, or an area has another form.
            DataError: a file cannot be written or read.
        """
        from semfov.report.drafts import drafts_section
        from semfov.report.gaze import gaze_page_html, gaze_part
        from semfov.report.template import write_html

        boxes = (None, None) if areas is None else self.areas(areas)
        drafts = self.first, self.second
        parts = [gaze_part(draft, draft.scanpaths(), these) for draft, these in zip(drafts, boxes, strict=True)]
        for part, name in zip(parts, self.names, strict=True):
            part["picture"]["name"] = name
        heading = title or "semfov: where people look in two drafts"
        return write_html(Path(path), gaze_page_html(heading, parts, drafts_section(self, areas)))
