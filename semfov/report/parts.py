"""Parts of a page, one for each record: episodes that the script draws, and looks that stand in the markup.

The data of a part are JSON values, which `semfov.report.episode` and `semfov.report.zoom` collect. A part makes of them
what the script reads, and the HTML of its places in the page.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from html import escape
from typing import ClassVar

from semfov.detection.objects import box_text
from semfov.report.episode import Data
from semfov.report.looks import article_html
from semfov.report.markup import left_out, scrollable

ABOUT = {
    "name": "Photograph",
    "pixels": "Size",
    "detector": "Detector",
    "sensor": "Sensor",
    "passes": "Passes of the detector",
    "decision": "Outcome",
}
"""Entries at the head of a part, by their keys in its data."""


def part_of(data: Data, number: int) -> Part:
    """Make the part of a page from the data of a record.

    Args:
        data: the data, which have `looks` where these stand in the markup, else `fixations`.
        number: number of the part in the page.

    Returns:
        The part.
    """
    return LooksPart(data, number) if "looks" in data else EpisodePart(data, number)


class Part(ABC):
    """Part of a page for one record.

    Args:
        data: the data of the record.
        number: number of the part in the page.
    """

    is_drawn_by_script: ClassVar[bool]
    """Whether its looks, which then are fixations, are not in the markup."""

    look: str
    """What a look is called."""

    nearest: str
    """What the look is called that shows an object most sharply."""

    def __init__(self, data: Data, number: int) -> None:
        self.data = data
        self.number = number

    @property
    @abstractmethod
    def place(self) -> str:
        """Start of the ids of its pictures."""

    @property
    def article(self) -> str:
        """Id of what the page has of it in the markup."""
        return self.place

    @property
    def pictures(self) -> list[str]:
        """Pictures that the script draws, as data URIs; none for looks, as their article embeds its own copies."""
        return []

    def looks_html(self, *, is_named: bool) -> str:
        """Make its article with looks; empty where the script draws them.

        Args:
            is_named: whether the name of the picture is shown.
        """
        return ""

    @property
    def section_html(self) -> str:
        """HTML section with the part's objects; empty if they are already in the part's article."""
        return ""

    @abstractmethod
    def script_data(self, numbers: Mapping[str, int]) -> Data:
        """Make what the script reads; `numbers` are those of the pictures."""

    @abstractmethod
    def crop_source(self, found: Data) -> tuple[str, float, float]:
        """Find the picture that shows an object most sharply.

        Args:
            found: data of the object.

        Returns:
            The id of the picture, and the place of its left upper corner, x and y in pixels of the record's picture.
        """

    def objects_html(self) -> str:
        """List the objects with what their boxes show, most confident first."""
        objects = self.data["objects"]
        if not self.data["count"]:
            doubt = " The best place, not sure enough, is dashed." if self.data["best"] else ""
            return f"<p>No objects were found.{doubt}</p>"
        # Cells are named by the heads of their columns; the crops have none.
        titles = "".join(map(_sortable_head, ["#", "", *self._object_cells(objects[0])]))
        rows = "".join(self._object_row(order, found) for order, found in enumerate(objects, 1))
        label = f"Objects with boxes x1,y1–x2,y2 in picture pixels and the {self.nearest}"
        table = (
            f'<table class="objects" aria-label="{label}"><thead><tr>{titles}</tr></thead><tbody>{rows}</tbody></table>'
        )
        return f"{scrollable(table, label)}{left_out(self.data['count'] - len(objects), 'object')}"

    def _object_cells(self, found: Data) -> dict[str, str]:
        """Write what the list says of an object, by the heads of its columns."""
        cells = {"class": escape(found["label"]), "score": f"{found['score']:.2f}"}
        if self.data["turns"]:
            cells["pan, tilt"] = f"{found['pan']:z.0f}°, {found['tilt']:z.0f}°"  # z: never -0°
        cells[self.look] = str(found["look"])
        if self.data["confirmable"]:
            cells["confirmed"] = "yes" if found["confirmed"] else "no"
        cells["box"] = box_text(found["box"])
        return cells

    def _object_row(self, order: int, found: Data) -> str:
        """Make the row of an object in the list."""
        numbers = "".join(f'<td class="number">{cell}</td>' for cell in self._object_cells(found).values())
        return (
            f'<tr data-object="{order}" data-look="{found["look"] - 1}"><th scope="row">'
            f'<button type="button" class="pick">{order}</button></th><td>{self._crop(found)}</td>{numbers}</tr>'
        )

    def _crop(self, found: Data) -> str:
        """Show the box of an object with a margin; the crop refers to a picture that is in the page already."""
        source, left, top = self.crop_source(found)
        x1, y1, x2, y2 = found["box"]
        margin = 0.1 * max(x2 - x1, y2 - y1, 1)
        x = x1 - left - margin
        y = y1 - top - margin
        width = x2 - x1 + 2 * margin
        height = y2 - y1 + 2 * margin
        view = f"{x:.1f} {y:.1f} {width:.1f} {height:.1f}"
        rem = min(4.0, 3 * width / height)  # a crop is 3 rem high, and narrower where it is wide
        style = f"width: {rem:.2f}rem"
        return f'<svg class="crop" viewBox="{view}" style="{style}" aria-hidden="true"><use href="#{source}"/></svg>'


def _sortable_head(title: str) -> str:
    """Make the head of a column that sorts the rows; a column without a title, the pictures, has none."""
    return f'<th scope="col"><button type="button" class="sort">{title}</button></th>' if title else "<td></td>"


class EpisodePart(Part):
    """Part of a page that the script draws: an episode of a fovea (`semfov.report.episode.episode_data`)."""

    is_drawn_by_script = True
    look = "fixation"
    nearest = "nearest fixation"

    @property
    def place(self) -> str:
        """Start of the ids of the pictures of the chosen episode."""
        return "episode"

    @property
    def article(self) -> str:
        """Id of its section with objects."""
        return f"objects-{self.number}"

    @property
    def pictures(self) -> list[str]:
        """The photograph and the foveated views that there are."""
        views = (fixation["view"] for fixation in self.data["fixations"])
        return [uri for uri in (self.data["image"], *views) if uri is not None]

    @property
    def section_html(self) -> str:
        """Its section with objects, which the script shows with its episode."""
        name = self.article
        return (
            f'<section class="found-objects of-episode" id="{name}" aria-labelledby="{name}-title">'
            f'<h3 id="{name}-title">Objects in {escape(self.data["name"])}</h3>{self.objects_html()}</section>'
        )

    def script_data(self, numbers: Mapping[str, int]) -> Data:
        """Make what the script reads: all but the objects, with numbers in place of the pictures."""
        data = {name: value for name, value in self.data.items() if name != "objects"}
        data["image"] = numbers.get(self.data["image"])
        data["fixations"] = [{**fixation, "view": numbers.get(fixation["view"])} for fixation in self.data["fixations"]]
        data["article"] = self.article
        return data

    def crop_source(self, found: Data) -> tuple[str, float, float]:
        """Find the picture of the chosen episode."""
        return f"{self.place}-picture", 0, 0


class LooksPart(Part):
    """Part of a page that is complete in the markup (`semfov.report.zoom.zoom_data`); the script chooses a look."""

    is_drawn_by_script = False
    look = "look"
    nearest = "sharpest look"

    @property
    def place(self) -> str:
        """Id of its article."""
        return f"large-{self.number}"

    def looks_html(self, *, is_named: bool) -> str:
        """Make its article; without the script the facts stand in it, but for those of the first part of the page.

        Args:
            is_named: whether the name of the picture is shown.
        """
        facts = {ABOUT[name]: self.data[name] for name in ABOUT if self.data[name] is not None}
        shown = {} if self.number == 0 else facts
        return article_html(self.data, self.place, self.objects_html(), shown, is_named=is_named)

    def script_data(self, numbers: Mapping[str, int]) -> Data:
        """Make what the script reads: facts and words about the looks."""
        looks = [{"box": look["box"], "status": look["status"]} for look in self.data["looks"]]
        return {**{name: self.data[name] for name in (*ABOUT, "summary")}, "article": self.article, "looks": looks}

    def crop_source(self, found: Data) -> tuple[str, float, float]:
        """Find the picture of the look that shows an object most sharply."""
        # Views of a head are no parts of the picture, and an object that is tracked may be shown by no look of a frame.
        if self.data["turns"] or not found["look"]:
            return f"{self.place}-picture", 0, 0
        index = found["look"] - 1
        left, top = self.data["looks"][index]["box"][:2]
        return f"{self.place}-look-{index + 1}-view", left, top
