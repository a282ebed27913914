"""The base of the records of what an agent looked at, detected and decided."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import fields as fields_of
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations
from semfov.data.windowed import LargePicture
from semfov.decision import CloseUp, Decision
from semfov.detection.detections import Detections
from semfov.detection.objects import LEAST, Objects
from semfov.errors import InputError
from semfov.paths.conversion import Conversion
from semfov.paths.endings import FIXATIONS, Ending
from semfov.paths.files import Format
from semfov.paths.look import LookView, RecordedLook, look_columns, read_region, whole_pixels
from semfov.paths.merging import CONFIRMED, confirm, distances_to, merge_fixations, number_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_NAMED = 5  # largest number of objects that the text form names


@dataclass(frozen=True, kw_only=True, repr=False)
class Record(Conversion):
    """Base of all records: its looks, what was looked for, what was found, what was decided, and why it ended.

    A record is the list of its looks (`looks`, or by iteration) and what its kind adds. Its objects are one set: those
    that `describe` counts, `plot` draws and `objects` returns. All points and boxes are in pixels of the picture.

    `describe` and `why_it_ended` tell it in words. `plot`, `to_frame`, `as_fixations` and `save` make a picture,
    tables, fixations in the format of human data, and a file.

    Attributes:
        classes: names of the classes, background first.
        target: class index 1..K that was searched for; None for all classes.
        detections: detections of each look, batches of one.
        found: whether a search found its target.
        closer: closer looks of a search, in order.
        ending: reason for the end; None if it is not known, and for a frame of a stream.
        seconds: time at the end of each look, on the clock of the episode; empty if the times are not known.
        decision: decision of a search; None for exploration, and for a search without one.
        targets: class indices 1..K of a search for several classes; otherwise empty.
        least: score from which on objects count, in windows their probability or score (`threshold_in_words`).
        unseen: number of objects that further looks are expected to show, and its variance; None where the scores are
            no probabilities.
        photograph: `(3, h, w)`, bytes, the reduced picture; None if it was not kept.
        source: file of the picture; None if it does not come from a file.
        shown: the `white` and the `bands` that were shown of the file; None for neither.

    Example::

        record = agent.find_all("harbour.tif", "person")
        print(record.describe(), record.objects.boxes)
        for look in record:
            print(look.number, look.fixation, int(look.detections.count))
    """

    classes: tuple[str, ...]
    target: int | None
    detections: tuple[Detections, ...]
    found: bool = False
    closer: tuple[CloseUp, ...] = ()
    ending: Ending | None = None
    seconds: tuple[Any, ...] = ()
    decision: Decision | None = None
    targets: tuple[int, ...] = ()
    least: float = LEAST
    unseen: tuple[float, float] | None = None
    photograph: Tensor | None = None
    source: str | None = None
    shown: Mapping[str, Any] | None = None

    how: ClassVar[Literal["fovea", "windows", "head"]]
    """Kind of look: of a fovea, at windows, or of a head that turns."""

    _format: ClassVar[Format]
    _sentences: ClassVar[Mapping[str, str]] = FIXATIONS

    @abstractmethod
    def _looks(self) -> Iterator[RecordedLook]:
        """The looks in their order, made anew."""

    @abstractmethod
    def describe(self) -> str:
        """Describe the outcome in one line."""

    @cached_property
    def looks(self) -> tuple[RecordedLook, ...]:
        """The looks in their order."""
        return tuple(self._looks())

    def __iter__(self) -> Iterator[RecordedLook]:
        """The looks in their order."""
        return iter(self.looks)

    def __len__(self) -> int:
        """Number of looks, the first included."""
        return len(self.detections)

    def __getitem__(self, number: int) -> RecordedLook:
        """The look of a number, as iteration gives it; -1 is the last one."""
        return self.looks[number]

    @property
    def passes(self) -> int:
        """Number of passes of the detector, closer looks included."""
        return len(self) + sum(look.number is None for look in self.closer)

    @property
    def target_name(self) -> str | None:
        """Name of the class that was searched for; None for all classes."""
        return None if self.target is None else self.classes[self.target]

    @property
    def measure(self) -> str:
        """What the scores of objects are: `probability` with a fitted certainty, otherwise `score`."""
        return "score" if self.unseen is None else "probability"

    @property
    def threshold_in_words(self) -> str:
        """From what on objects count, such as `probability or score 0.5`; in a search only the probability counts."""
        score = " or score" if self.decision is None and self.unseen is not None else ""
        return f"{self.measure}{score} {self.least:g}"

    @property
    def decided_by(self) -> str:
        """What the number of the decision is: a `probability`, a `belief` without thresholds, or the best `score`."""
        return "probability"

    @property
    def found_at(self) -> tuple[float, float] | None:
        """`(x, y)` in picture pixels of the found target: the middle of its box, or else of its cell; None for none."""
        decision, grid = self.decision, getattr(self, "grid", None)
        if decision is not None and decision.outcome == "found" and decision.box is not None:
            x1, y1, x2, y2 = decision.box.tolist()
            return (x1 + x2) / 2, (y1 + y2) / 2
        if decision is None or decision.outcome != "found" or decision.cell is None or not isinstance(grid, Grid):
            return None
        return tuple(grid.centres[decision.cell].tolist())

    @property
    def image(self) -> Tensor | None:
        """The reduced picture, `(3, h, w)` in [0, 1]; None if it was not kept."""
        return None if self.photograph is None else self.photograph.float() / 255

    def is_whole(self, region: Sequence[float]) -> bool:
        """Whether a region is the whole picture, up to a pixel.

        Args:
            region: `(x1, y1, x2, y2)` in picture pixels.

        Returns:
            Whether it is.
        """
        (x1, y1, x2, y2), (width, height) = region, self.size
        return x2 - x1 > width - 1 and y2 - y1 > height - 1

    @cached_property
    def candidates(self) -> Objects:
        """Objects merged from the detections of all looks, of all scores from 0.05 on, with boxes in picture pixels.

        Of several boxes of one object, the box of the nearest fixation is kept, or that of a closer look. The score of
        a closer look is the probability that the target is there.
        """
        looks = [look.detections for look in self]
        distances = [
            distances_to(look.detections.boxes[0], torch.tensor(look.fixation, dtype=torch.float64)) for look in self
        ]
        return merge_fixations(looks, distances, self.closer)

    @property
    def objects(self) -> Objects:
        """The candidates of the targets that have at least the score `least`, or that were confirmed.

        A candidate that was confirmed has the probability that the target is there as its score, where that is higher.
        The box that a decision found is always among the objects.
        """
        return self._outcome[0]

    @property
    def confirmed(self) -> Tensor:
        """Which of the objects a closer look or the decision confirmed, `(M,)` boolean."""
        return self._outcome[1]

    @property
    def confirmable(self) -> bool:
        """Whether objects can be confirmed: by a decision or by closer looks."""
        return self.decision is not None or len(self.closer) > 0

    @property
    def refuted(self) -> list[CloseUp]:
        """The closer looks that did not confirm that the target is there."""
        boxes = [box for box, *_ in self._confirmed_places]
        return [look for look in self.closer if not any(look.box.equal(box) for box in boxes)]

    @property
    def expected(self) -> dict[str, float]:
        """Expected number of objects by the name of their class; without a model of it, the number of `objects`.

        With a model it is the sum of the probabilities of all candidates, and of what further looks are expected to
        show, of which each class has its share of that sum. It is NaN for a class to which the detector hardly reacts
        (`semfov.paths.ZoomPath.reacts`), and null in files.
        """
        return {name: mean for name, (mean, _) in self._claimed().items()}

    @property
    def expected_error(self) -> dict[str, float]:
        r"""Standard deviation of the expected number of objects by the name of their class; 0 without a model of it.

        With a model of the picture the candidates are independent (a Poisson-binomial distribution), and what no look
        has shown has the distribution of `semfov.zoom.certainty`. Pictures differ in how far the model suits them, by a
        share :math:`\tau` (`spread`) of the expected number E:

        .. math:: \sigma^2 = \sum_i p_i (1 - p_i) + \operatorname{Var}[n] + \tau^2 E^2
        """
        return {name: variance**0.5 for name, (_, variance) in self._claimed().items()}

    def _claimed(self) -> dict[str, tuple[float, float]]:
        """Mean and variance of the number of objects of each class."""
        counts = Counter(self.objects.labels.tolist())
        return {self.classes[label]: (float(counts[label]), 0.0) for label in self._sought or counts}

    @property
    def _sought(self) -> tuple[int, ...]:
        """Classes that were searched for; none stands for all."""
        return self.targets or (() if self.target is None else (self.target,))

    @property
    def _confirmed_places(self) -> list[tuple[Tensor, int, float, int]]:
        """Box, class, probability and look of the places that closer looks and the decision confirmed."""
        decision, closer = self.decision, self.closer
        box = decision.box if decision is not None and decision.outcome == "found" else None
        others = [look for look in closer if look.place >= CONFIRMED and (box is None or not look.box.equal(box))]
        places = [(look.box, look.target, look.place, number_of(look)) for look in others]
        if box is not None and decision is not None and self.target is not None:
            number = next((number_of(look) for look in closer if look.box.equal(box)), len(self) - 1)
            probability = decision.probability if decision.place is None else decision.place
            places.append((box, self.target, probability, number))
        return places

    @cached_property
    def _outcome(self) -> tuple[Objects, Tensor]:
        """The objects, and which of them were confirmed."""
        objects, sure = confirm(self.candidates.of(self._sought), self._confirmed_places, self._counts)
        return replace(objects, classes=self.classes), sure

    def _counts(self, candidates: Objects) -> Tensor:
        """Which candidates of the classes that were searched for count as objects without being confirmed, `(M,)`."""
        return candidates.scores >= self.least

    def objects_in_words(self) -> str:
        """Count the objects, by class where classes were searched for, and say from which score on.

        Returns:
            A phrase such as `2 × person from score 0.3`.
        """
        labels = self.objects.labels
        names = [f"{int((labels == label).sum())} × {self.classes[label]}" for label in self._sought]
        every = f"{len(labels)} object{'s' if len(labels) != 1 else ''}"
        return f"{', '.join(names) or every} from {self.threshold_in_words}"

    def why_it_ended(self) -> str:
        """Explain in one sentence why the search or the exploration ended.

        Returns:
            The sentence; empty if the reason is not known.
        """
        sentences, looks = self._sentences, self.passes
        if self.closer and self.found:
            # Windows as large as the picture: the first look is a closer look already.
            box = None if self.decision is None else self.decision.box
            showing = [look.number for look in self.closer if box is not None and look.box.equal(box)]
            found = sentences["closer found"]
            return sentences.get("first found", found) if showing == [0] else found
        if self.ending == "decision" and self.decision is not None:
            outcome, closer = self.decision.outcome, any(look.number != 0 for look in self.closer)
            return sentences.get(f"closer {outcome}" if closer else outcome, sentences[outcome])
        if self.ending == "shifts":
            return f"All {len(self) - 1} gaze shifts were made."
        if self.ending == "passes":
            return f"All {looks} passes were used." if looks != 1 else "The only pass was used."
        return sentences.get(self.ending or "", "")

    def summary(self) -> str:
        """Describe the outcome, and explain why the search or the exploration ended."""
        return f"{self.describe()}. {self.why_it_ended()}".rstrip()

    def __repr__(self) -> str:
        """The summary, the looks, and the most confident objects."""
        objects, sure = self.objects, self.confirmed.tolist()
        rows = zip(objects.labels.tolist()[:_NAMED], objects.scores.tolist(), sure, strict=False)
        named = [f"{self.classes[label]} {score:.2f}{' (confirmed)' * confirmed}" for label, score, confirmed in rows]
        more = [f"and {len(objects) - _NAMED} more"] if len(objects) > _NAMED else []
        found = f"objects from {self.threshold_in_words}: {', '.join([*named, *more]) or 'none'}"
        return "\n  ".join([f"{type(self).__name__}: {self.summary()}", *self._lines(), found])

    def _lines(self) -> list[str]:
        """Lines of the text form on the looks."""
        return []

    def outline(self, look: RecordedLook) -> Tensor | None:
        """The border of what a look shows.

        Args:
            look: the look.

        Returns:
            `(P, 2)`, points in picture pixels, the first one again at the end; None for the whole picture.
        """
        x1, y1, x2, y2 = look.region
        corners = [(x1, y1), (x2, y1), (x2, y2), (x1, y2), (x1, y1)]
        return None if self.is_whole(look.region) else torch.tensor(corners)

    @property
    def around(self) -> float | None:
        """Width in pixels after which the picture repeats, as a panorama does; None for other pictures."""
        return None

    def belief_map(self, number: int) -> tuple[Grid, Tensor] | None:
        """The belief after a look.

        Args:
            number: number of the look.

        Returns:
            The cells, and the probability `(cells,)` that each of them holds the target, or any object; None for
            windows.
        """
        return None

    def look_views(self, source: LargePicture) -> Iterator[LookView]:
        """What the looks showed, as sharp as the detector saw it.

        Args:
            source: the opened picture, in any size.

        Yields:
            Pixels, boxes and gaze of each look.
        """
        for look in self:
            x1, y1, x2, y2 = whole_pixels(look.region, self.size)
            across = max(1, round((x2 - x1) * look.more.get("magnification", 1.0)))
            boxes = look.detections.boxes[0] - look.detections.boxes.new_tensor([x1, y1, x1, y1])
            (x, y), pixels = look.fixation, read_region(source, (x1, y1, x2, y2), self.size, across)
            yield LookView(pixels, (x2 - x1, y2 - y1), boxes, (x - x1, y - y1))

    def sensor_in_words(self) -> str | None:
        """Describe through what was looked.

        Returns:
            The description; None if it is not known.
        """
        return None

    def as_fixations(self, picture: str, subject: str = "semfov") -> Fixations:
        """The fixations in the format of human data, to write with `semfov.data.fixations` or to compare by metrics.

        Args:
            picture: name of the picture.
            subject: name of the observer.

        Returns:
            The fixations, with the target of a search and whether it was found.
        """
        points = torch.tensor([look.fixation for look in self], dtype=torch.float64).view(-1, 2).numpy()
        found = None if self.target is None else self.found
        return Fixations(picture, subject, points, self.size, target=self.target_name, found=found)

    def compare(
        self, people: Fixations | Record | Sequence[Fixations | Record] | str | PathLike[str]
    ) -> Mapping[str, tuple[float, float]]:
        """Compare the fixations with those of people in the same picture (`semfov.metrics.scanpath.compare_scanpath`).

        Args:
            people: fixations, those of one person, or the path of a file (`semfov.data.fixations.read_fixations`).

        Returns:
            Each measure of this record and of the people among themselves; it prints as a table.
        """
        from semfov.metrics.scanpath.beside import compare_scanpath

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

    def report(self, path: str | PathLike[str], **options: Any) -> Path:
        """Write an HTML page of the looks and the objects, a single file that loads nothing from elsewhere.

        Args:
            path: the file.
            options: `picture`, the picture in full size, in which narrow windows are sharp; None takes the one that the
                record keeps. `name`, the name of the picture on the page. `boxes`, `(M, 4)`, true boxes of the target.

        Returns:
            The path.

        Raises:
            InputError: the picture was not kept, and none is given.
            DataError: the file cannot be written.
        """
        from semfov.report.page import write_page

        return write_page(Path(path), f"semfov: {self.describe()}", [self.page_data(**options)])

    def page_data(self, picture: Any = None, *, name: str | None = None, **options: Any) -> dict[str, Any]:
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
        """What a notebook shows."""
        from semfov.report.notebook import record_html

        return record_html(self)

    def rows(self) -> list[dict[str, Any]]:
        """The looks as a table of plain values, one row for each look, whose first columns all kinds of records have.

        `look` is the number of the look, `x` and `y` are the fixated point, and `x1`, `y1`, `x2` and `y2` the part of
        the picture that it shows, in picture pixels. `detections` is the number of detections, `seen` the class of the
        most confident one, and `score` its confidence. `seconds` is the time at the end of the look, on the clock of
        the episode. `value` is that for which the look was chosen. `closer` is the probability that the target is
        there, by a closer look that this is, or that follows it. `brought` is the number of objects that it shows most
        sharply. The columns that the kind adds come last.

        Returns:
            One dictionary for each look.
        """
        closer = {number_of(look): look.place for look in self.closer}
        brought = Counter(self.objects.passes.tolist())
        return [look_columns(look, self.classes, closer.get(look.number), brought[look.number]) for look in self]

    def to_dict(self) -> dict[str, Any]:
        """The outcome, the objects (`object_rows`) and the looks (`rows`) as JSON values, without unclaimed numbers.

        Returns:
            Values by name; None for the box of what was not found, and for numbers and errors that are not claimed.
        """
        (width, height), decision = self.size, self.decision
        values: dict[str, Any] = {"picture": self.source, "width": width, "height": height, "target": self.target_name}
        values["targets"] = [self.classes[label] for label in self._sought]
        if decision is not None:
            box = decision.box.tolist() if decision.outcome == "found" and decision.box is not None else [None] * 4
            values |= {"outcome": decision.outcome, "probability": decision.probability}
            edges = (*(self.found_at or (None, None)), *box)
            values |= dict(zip(("x", "y", "x1", "y1", "x2", "y2"), edges, strict=True))
        error = dict.fromkeys(self.expected, math.nan) if self.unseen is None else self.expected_error
        values["least"] = self.least
        for key, numbers in (("expected", self.expected), ("expected_error", error)):
            values[key] = {name: None if math.isnan(number) else number for name, number in numbers.items()}
        values["passes"] = self.passes
        return {**values, "summary": self.summary(), "objects": self.object_rows(), "looks": self.rows()}

    def save(self, path: str | PathLike[str]) -> None:
        """Write the record to a safetensors file, atomically.

        Args:
            path: the file.

        Raises:
            InputError: the name is that of a table, a page, a picture or a film.
            DataError: the file cannot be written.
        """
        self._format.write(path, vars(self), *self._contents())

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
            fields = {**shared, **cls._fields(tensors, record, shared)}
        except InputError as error:
            raise cls._format.refused(path, error) from None
        made = {each.name for each in fields_of(cls) if each.init}
        return cls(**{name: value for name, value in fields.items() if name in made})

    @abstractmethod
    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and JSON values of a file, beside those of the base."""

    @classmethod
    @abstractmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Make the other attributes from the tensors and JSON values of a file."""
