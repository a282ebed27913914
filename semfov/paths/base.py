"""The base of the records of what an agent looked at, detected and decided."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as fields_of
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.inputs import Color, ImageLike, as_image
from semfov.data.windowed import LargePicture
from semfov.decision import CloseUp
from semfov.detection.detections import Detections
from semfov.errors import DataError, InputError, check, check_options, reason_of
from semfov.paths.conversion import Conversion, Values
from semfov.paths.files import PLAIN, Format, SharedFields
from semfov.paths.look import Box, LookView, RecordedLook, read_region, whole_pixels
from semfov.paths.regions import Region

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAMED = 5  # largest number of objects that the text form names


class Record(Conversion):
    """Base of all records: its looks, what was looked for, what was found, what was decided, and why it ended.

    A record lists its looks (`looks`, or by iteration); each kind of record adds attributes. The objects that
    `describe` counts, `plot` draws and `objects` returns are the same. All points and boxes are in pixels of the
    picture.

    `describe`, `why_it_ended` and `words` describe the record in words. `plot`, `to_frame`, `as_fixations` and `save`
    make a figure, tables, fixations in the format of human data, and a file.

    Attributes:
        classes: names of the classes, background first.
        target: class index 1..K that was searched for; None for all classes.
        looks: the looks in their order.
        found: whether a search found its target.
        closer: closer looks of a search, in order.
        ending: reason for the end; None if it is not known, and for a frame of a stream.
        decision: decision of a search; None for exploration, and for a search without one.
        prior: share of the pictures that hold the target, if it was given to the search; else None.
        assumed: the share that the probability of the decision assumes, one half without a `prior` (see
            `probability_at`). None if it is not known.
        targets: class indices 1..K of a search for several classes; otherwise empty.
        score_threshold: least score of a listed object, with windows its least probability (`words.threshold`).
        unseen: number of objects that further looks are expected to show, and its variance; None if scores are not
            probabilities.
        photograph: `(3, h, w)`, bytes, the reduced picture; None if it was not kept.
        source: file of the picture; None if it does not come from a file.
        shown: the settings `white` and `bands` with which the file was read; None for neither.
        detector: name of the detector; None if it is not known.

    Example::

        record = agent.find_all("harbour.tif", "person")
        print(record.describe(), record.objects.boxes)
        for look in record:
            print(look.number, look.fixation, int(look.detections.count))
    """

    _format: ClassVar[Format]
    _page_options: ClassVar[tuple[str, ...]] = ("picture", "name", "boxes", "width", "quality")

    def __str__(self) -> str:
        """Return the summary, the looks, and the most confident objects."""
        rows = self.object_rows()
        names = []
        for row in rows[:_NAMED]:
            confirmed = " (confirmed)" if row["confirmed"] else ""
            names.append(f"{row['class']} {row['score']:.2f} at ({row['x']:z.0f}, {row['y']:z.0f}){confirmed}")
        if len(rows) > _NAMED:
            names.append(f"and {len(rows) - _NAMED} more")
        objects = f"objects from {self.words.threshold}: {', '.join(names) or 'none'}"
        return "\n  ".join([self.summary(), *self.words.lines, objects])

    def __repr__(self) -> str:
        """Return the same, after the name of the class."""
        return f"{type(self).__name__}: {self}"

    def outline(self, look: RecordedLook) -> Tensor | None:
        """Return the border of what a look shows.

        Args:
            look: the look.

        Returns:
            `(P, 2)`, points in picture pixels, the first one again at the end; None for the whole picture.
        """
        if self.is_whole(look.region):
            return None
        x1, y1, x2, y2 = look.region
        return torch.tensor([(x1, y1), (x2, y1), (x2, y2), (x1, y2), (x1, y1)])

    @property
    def around(self) -> float | None:
        """Width in pixels after which the picture repeats, as a panorama does; None for other pictures."""
        return None

    def belief_map(self, index: int) -> tuple[Grid, Tensor] | None:
        """Return the belief after a look.

        Args:
            index: place of the look in the record, from 0; negative ones count from the end.

        Returns:
            The cells, and the probability `(cells,)` that each of them holds the target, or any object; None for
            windows.

        Raises:
            InputError: the record has no such look.
        """
        self._place(index)
        return None

    def regions(self, index: int = -1) -> Sequence[Region]:
        """Find the regions in the map of classes that an exploration with a fovea makes.

        Args:
            index: place of the look after which the map is read, from 0; negative ones count from the end.

        Returns:
            Regions of adjacent cells with the same class, the largest first; none without such a map.
        """
        return ()

    def figures(self, boxes: Tensor | None = None) -> dict[str, Callable[[], Figure]]:
        """List the figures of the record as functions, each of which draws one.

        Args:
            boxes: `(M, 4)`, true boxes of the target, drawn dashed.

        Returns:
            Functions by the name of the figure.
        """
        return {"scanpath": partial(self.plot, boxes=boxes)}

    def look_views(self, source: LargePicture) -> Iterator[LookView]:
        """Iterate over the views of the looks, as sharp as the detector saw them.

        Args:
            source: the opened picture, in any size.

        Yields:
            Pixels, boxes and gaze of each look.
        """
        for look in self:
            region = whole_pixels(look.region, self.size)
            left, top, right, bottom = region
            width = right - left
            # Read no more pixels than the detector saw of it.
            width_seen = max(1, round(width * look.more.get("magnification", 1.0)))
            pixels = read_region(source, region, self.size, width_seen)
            boxes = look.detections.boxes[0]  # (L, 4)
            boxes_in_view = boxes - boxes.new_tensor([left, top, left, top])
            x, y = look.fixation
            yield LookView(pixels, (width, bottom - top), boxes_in_view, (x - left, y - top))

    def as_fixations(self, picture: str, subject: str = "semfov") -> Fixations:
        """Convert the fixations to the format of human data (`semfov.data.fixations`), to write or to compare them.

        Args:
            picture: name of the picture.
            subject: name of the observer.

        Returns:
            The fixations, with the target of a search and whether it was found.
        """
        # (n, 2), also without a fixation.
        points = torch.tensor([look.fixation for look in self.fixated], dtype=torch.float64).view(-1, 2).numpy()
        found = None if self.target is None else self.found
        return Fixations(picture, subject, points, self.size, target=self.target_name, found=found)

    def compare(
        self, people: Fixations | Record | Sequence[Fixations | Record] | str | PathLike[str]
    ) -> Mapping[str, tuple[float, float]]:
        """Compare the fixations with those of people in the same picture (`semfov.metrics.scanpath.compare_scanpath`).

        Args:
            people: fixations, those of one person, or the path of a file (`semfov.data.fixations.read_fixations`).

        Returns:
            Each measure between this record and the people, and between the people; it prints as a table.
        """
        from semfov.human.scanpath.beside import compare_scanpath

        return compare_scanpath(self, people)

    def plot(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the looks and the objects on the picture.

        Args:
            ax: axes to draw in; None makes a new figure.
            options: those of `semfov.viz.plot_scanpath`: `image`, the picture, where the record does not keep it, …

        Returns:
            The figure.

        Raises:
            InputError: the picture was not kept, and none is given.
        """
        from semfov.viz.scanpath import plot_scanpath

        return plot_scanpath(self, ax=ax, **options)

    def animate(self, path: str | PathLike[str] | None = None, **options: Any) -> Path | Any:
        """Make a film of the looks, one frame for each.

        Args:
            path: GIF file to write; None returns the film for a notebook.
            options: those of `semfov.viz.animate`: `seconds`, how long a frame lasts; `hold`, how much longer the last
                one does; and `image`, the picture, where the record does not keep it.

        Returns:
            The path, or an object that a notebook shows as an animation.

        Raises:
            InputError: the picture was not kept, and none is given.
            DataError: the file cannot be written.
        """
        from semfov.viz.animation import animate

        return animate(self, path, **options)

    def report(self, path: str | PathLike[str], *, title: str | None = None, **options: Any) -> Path:
        """Write an HTML page of the looks and the objects, a single file that loads nothing from elsewhere.

        Args:
            path: the file.
            title: heading of the page; None: the target.
            options: `picture`, the picture in full size, from which small windows are sharp; None: the one in the
                record. `name`, the name of the picture on the page. `boxes`, `(M, 4)`, true boxes of the target.
                `width`, that of the page's pictures in pixels, and `quality`, that of their JPEGs.

        Returns:
            The path.

        Raises:
            InputError: the picture was not kept, and none is given; or an option is unknown.
            DataError: the file cannot be written.
        """
        from semfov.report.page import write_page

        # What makes the data of the page knows neither the title nor whose option it is.
        check_options(options, ["title", *self._page_options], "report")
        return write_page(Path(path), title or f"semfov: {self.words.task}", [self.page_data(**options)])

    def page_data(self, picture: Any = None, *, name: str | None = None, **options: Any) -> Values:
        """Collect the data of the record for a page (`semfov.report.zoom.zoom_data`, for a scanpath `episode_data`).

        Args:
            picture: the picture in full size; None takes the one that the record keeps.
            name: name of the picture; None takes that of its file, or its size.
            options: further arguments of the function.

        Returns:
            The data, for `semfov.report.write_page`.

        Raises:
            InputError: the picture is not that of the record, or was not kept.
        """
        from semfov.report.zoom import zoom_data

        return zoom_data(self, picture, name=name or self._picture_name, **options)

    @property
    def _picture_name(self) -> str:
        """Name of the picture on a page: that of its file, or its size."""
        width, height = self.size
        return Path(self.source).name if self.source else f"{width} × {height} px"

    def _repr_html_(self) -> str:
        """Show the record in a notebook."""
        from semfov.report.notebook import record_html

        return record_html(self)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the record to a safetensors file, atomically.

        Args:
            path: the file.

        Raises:
            InputError: the name is that of a table, a page, a picture or a film.
            DataError: the file cannot be written.
        """
        self._format.write(path, self, *self._contents())

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Self:
        """Load a record that `save` wrote; nothing in the file is executed.

        Args:
            path: the file.

        Returns:
            The record.

        Raises:
            DataError: the file is missing or damaged, or holds no record of this kind.
        """
        try:
            tensors, record, shared = cls._format.read(path)
            plain = {name: record.get(name) for name in PLAIN}
            fields = {**plain, **shared, **cls._fields(tensors, record, shared)}
        except InputError as error:
            got = reason_of(error)
            raise DataError(f"{path}: expected a complete {cls._format.kind}, got: {got}") from None
        # What a record derives from its looks is in the file, too, and no argument.
        arguments = {field.name for field in fields_of(cls) if field.init}
        return cls(**{name: value for name, value in fields.items() if name in arguments})

    @abstractmethod
    def _contents(self) -> tuple[dict[str, Tensor | None], Values]:
        """Tensors and JSON values of a file, beside those of the base; tensors that are None are left out."""

    @classmethod
    @abstractmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        """Make the other attributes from the tensors and JSON values of a file."""


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Moment(Record):
    """Base of the records of one frame of a stream.

    Attributes:
        number: number of the frame, from 0.
        decision: decision at this frame: `found`, `absent` or `undecided`; None if there is no target.

    Example::

        moment = live.step(frame)
        print(moment.describe(), moment.objects.boxes)
    """

    number: int

    _goes_on = True

    @property
    def seen(self) -> Detections:
        """Detections of the look at this frame, a batch of one."""
        return self.looks[-1].detections

    @property
    def examined(self) -> CloseUp | None:
        """The closer look, if this frame was spent on one; otherwise None."""
        return next((look for look in self.closer if look.index == len(self) - 1), None)

    @property
    @abstractmethod
    def next_point(self) -> tuple[float, float]:
        """The point `(x, y)` of the next look, in pixels."""

    @property
    def ways(self) -> dict[int, list[tuple[float, float]]]:
        """The paths of the objects in the last frames, by their numbers: points `(x, y)` in pixels of this frame."""
        return {}

    @property
    def next_region(self) -> Box | None:
        """`(x1, y1, x2, y2)` in pixels, the part of the frame that the next look shows; None for all of it."""
        return None

    def draw(self, frame: ImageLike, *, color: Color = "bgr", longest: int | None = None) -> NDArray[np.uint8]:
        """Draw the look, the belief or the objects, and the place of the next look into the frame.

        Matplotlib is not needed.

        Args:
            frame: the frame of the moment.
            color: order of the channels of the frame and of the drawing: `bgr`, as OpenCV reads and shows them, or
                `rgb`.
            longest: longer side of the drawing in pixels, to which a larger frame is reduced; None keeps the size.

        Returns:
            `(h, w, 3)`, bytes.

        Raises:
            InputError: it is no frame of the size of the moment's.

        Example::

            moment = live.step(frame)
            cv2.imshow("semfov", moment.draw(frame))
        """
        from semfov.viz.live import draw_moment, reduced

        image = as_image(frame, argument="frame", color=color)
        width, height = self.size
        size = tuple(image.shape[:0:-1])  # of (3, H, W), width first
        check(size == self.size, "frame", f"{width} × {height} px", size)
        drawing_size = self.size if longest is None else reduced(self.size, longest)
        # In RGB, from which OpenCV differs by the order of the channels alone.
        drawing = draw_moment(image, self, self.describe(), drawing_size)
        return np.ascontiguousarray(drawing[..., ::-1]) if color == "bgr" else drawing
