"""The base of the records of what an agent looked at, detected and decided."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as fields_of
from functools import cached_property
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, get_args

from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.decision import CloseUp, Decision
from semfov.detection.detections import Detections
from semfov.detection.objects import LEAST, Objects
from semfov.errors import InputError, check
from semfov.paths.conversion import Conversion
from semfov.paths.drawing import drawing_of
from semfov.paths.endings import FIXATIONS, Ending, sentence
from semfov.paths.files import Format
from semfov.paths.merging import ConfirmedPlace, confirm, places_confirmed

if TYPE_CHECKING:
    from pathlib import Path

    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_Table = Literal["looks", "objects"]
"""Tables of a record."""

_COLUMNS = ["object", "class", "score", "confirmed", "x", "y", "x1", "y1", "x2", "y2", "look"]
_NAMED = 5  # largest number of objects that the text form names


@dataclass(frozen=True)
class RecordedLook:
    """One look of a record, in pixels of the picture.

    Attributes:
        number: number of the look, from 0.
        fixation: `(x, y)`, the fixated point.
        region: `(x1, y1, x2, y2)`, the part of the picture that the look shows.
        detections: its detections, a batch of one.
        seconds: time that it took; None if it is not known.
        value: value for which it was chosen; None if it was not chosen by a value.

    Example::

        for look in agent.search("kitchen.jpg", "cup"):
            print(look.number, look.fixation, look.seconds)
    """

    number: int
    fixation: tuple[float, float]
    region: tuple[float, float, float, float]
    detections: Detections
    seconds: float | None = None
    value: float | None = None


@dataclass(frozen=True, kw_only=True, repr=False)
class Record(Conversion):
    """Base of all records: what was looked for, what was found, and what was decided, in words and as tables.

    Iterating over a record gives its looks one by one (`RecordedLook`). Its objects are one set: those that `describe`
    counts, `plot` draws and `objects` returns.

    Attributes:
        classes: names of the classes, background first.
        target: class index 1..K that was searched for; None for all classes.
        decision: decision of a search; None for exploration, and for a search without one.
        targets: class indices 1..K of a search for several classes; otherwise empty.
        least: score from which on objects count; where scores are probabilities (`measure`), the probability.
        photograph: `(3, h, w)`, bytes, the reduced picture (`semfov.paths.reduced_copy`); None if it was not kept.
        source: file of the picture; None if it does not come from a file.

    Example::

        record = agent.find_all("harbour.tif", "person")
        print(record.describe(), record.objects.boxes)
        for look in record:
            print(look.number, look.fixation, int(look.detections.count))
    """

    classes: tuple[str, ...]
    target: int | None
    decision: Decision | None = None
    targets: tuple[int, ...] = ()
    least: float = LEAST
    photograph: Tensor | None = None
    source: str | None = None

    _format: ClassVar[Format]

    def is_whole(self, region: Sequence[float]) -> bool:
        """Whether a region is the whole picture, up to a pixel.

        Args:
            region: `(x1, y1, x2, y2)` in picture pixels.

        Returns:
            Whether it is.
        """
        (x1, y1, x2, y2), (width, height) = region, self.size
        return x2 - x1 > width - 1 and y2 - y1 > height - 1

    @property
    def decided_by(self) -> str:
        """What the number of the decision is: a `probability`, a `belief` without thresholds, or the best `score`."""
        return "probability"

    @property
    def target_name(self) -> str | None:
        """Name of the class that was searched for; None for all classes."""
        return None if self.target is None else self.classes[self.target]

    @property
    def measure(self) -> str:
        """What `least` is compared with, in a word: `score`, or `probability`."""
        return "score"

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture in pixels."""

    @property
    def image(self) -> Tensor | None:
        """The reduced picture, `(3, h, w)` in [0, 1]; None if it was not kept."""
        return None if self.photograph is None else self.photograph.float() / 255

    @property
    @abstractmethod
    def passes(self) -> int:
        """Number of passes of the detector, closer looks included."""

    @abstractmethod
    def __iter__(self) -> Iterator[RecordedLook]:
        """The looks in their order."""

    @cached_property
    def candidates(self) -> Objects:
        """Objects merged from the detections of all looks, of all scores from 0.05 on, with boxes in picture pixels."""
        raise NotImplementedError

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
        return self.decision is not None or len(self.closer_looks) > 0

    @property
    def expected(self) -> dict[str, float]:
        """Expected number of objects by the name of their class; without a model of it, the number of `objects`."""
        counts = Counter(self.objects.labels.tolist())
        labels = self._sought() or tuple(counts)
        return {self.classes[label]: float(counts[label]) for label in labels}

    def _sought(self) -> tuple[int, ...]:
        """Classes that were searched for; none stands for all."""
        return self.targets or (() if self.target is None else (self.target,))

    @cached_property
    def _outcome(self) -> tuple[Objects, Tensor]:
        """The objects, and which of them were confirmed."""
        return confirm(self.candidates.of(self._sought()), self._confirmations(), self.least)

    @property
    def refuted(self) -> list[CloseUp]:
        """The closer looks that did not confirm that the target is there."""
        boxes = [place.box for place in self._confirmations()]
        return [look for look in self.closer_looks if not any(look.box.equal(box) for box in boxes)]

    def _confirmations(self) -> list[ConfirmedPlace]:
        """Places that closer looks and the decision confirmed."""
        return places_confirmed(self._decision_in_picture(), self.target, self.closer_looks, self._last())

    def _last(self) -> int:
        """Number of the last look."""
        return 0

    @property
    def closer_looks(self) -> Sequence[CloseUp]:
        """The closer looks."""
        return ()

    def _decision_in_picture(self) -> Decision | None:
        """The decision, with its box in pixels of the picture."""
        return self.decision

    def objects_in_words(self) -> str:
        """Count the objects, by class where classes were searched for, and say from which score on.

        Returns:
            A phrase such as `2 × person from score 0.3`.
        """
        labels = self.objects.labels
        names = [f"{int((labels == label).sum())} × {self.classes[label]}" for label in self._sought()]
        every = f"{len(labels)} object{'s' if len(labels) != 1 else ''}"
        return f"{', '.join(names) or every} from {self.measure} {self.least:g}"

    @abstractmethod
    def describe(self) -> str:
        """Describe the outcome in one line."""

    def summary(self) -> str:
        """Describe the outcome, and explain why it ended if it did."""
        return self.describe()

    def __repr__(self) -> str:
        """The summary, and lines about the looks."""
        return "\n".join([f"{type(self).__name__}: {self.summary()}", *(f"  {line}" for line in self._lines())])

    def _lines(self) -> list[str]:
        """Lines of the text form after the summary."""
        return [self._listed()]

    def _listed(self) -> str:
        """The most confident objects in words."""
        objects, sure = self.objects, self.confirmed.tolist()
        named = [
            f"{self.classes[label]} {score:.2f}{' (confirmed)' if confirmed else ''}"
            for label, score, confirmed in zip(
                objects.labels.tolist()[:_NAMED], objects.scores.tolist(), sure, strict=False
            )
        ]
        more = [f"and {len(objects) - _NAMED} more"] if len(objects) > _NAMED else []
        return f"objects from {self.measure} {self.least:g}: {', '.join([*named, *more]) or 'none'}"

    def plot(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the looks and the objects on the picture.

        Args:
            ax: axes to draw in; None makes a new figure.
            options: options of the function that draws this kind of records, such as `image`, the picture, which must
                be given where the record does not keep it.

        Returns:
            The figure.

        Raises:
            InputError: the picture was not kept, and none is given.
        """
        figure: Figure = drawing_of("plot", type(self))(self, ax=ax, **options)
        return figure

    def animate(self, path: str | PathLike[str] | None = None, **options: Any) -> Path | Any:
        """Make a film of the looks, one frame for each.

        Args:
            path: GIF file to write; None returns the film for a notebook.
            options: options of the function that draws this kind of records: `seconds`, the duration of a frame;
                `hold`, the additional duration of the last frame; and `image`, the picture, which must be given where
                the record does not keep it.

        Returns:
            The path, or an object that a notebook shows as an animation.

        Raises:
            InputError: the picture was not kept, and none is given.
            DataError: the file cannot be written.
        """
        return drawing_of("animate", type(self))(self, path, **options)

    def report(self, path: str | PathLike[str], **options: Any) -> Path:
        """Write an HTML page of the looks and the objects, a single file that loads nothing from elsewhere.

        Args:
            path: the file.
            options: `picture`, the picture in full size, in which narrow windows are sharp; None takes the one that the
                record keeps. `name`, the name of the picture on the page.

        Returns:
            The path.

        Raises:
            InputError: the picture was not kept, and none is given.
            DataError: the file cannot be written.
        """
        written: Path = drawing_of("report", type(self))(self, path, **options)
        return written

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return str(drawing_of("notebook", type(self))(self))

    @abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """The looks as a table of plain values.

        Returns:
            One dictionary for each look.
        """

    def object_rows(self) -> list[dict[str, Any]]:
        """The objects as a table of plain values, one row for each object, most confident first.

        `x1`, `y1`, `x2` and `y2` are its box and `x` and `y` the middle of the box, in picture pixels. `look` is the
        number of the look that shows it most sharply.

        Returns:
            One dictionary for each object.
        """
        objects = self.objects
        columns = (objects.labels, objects.scores, self.confirmed, objects.passes, objects.boxes)
        return [
            {
                "object": number,
                "class": self.classes[label],
                "score": score,
                "confirmed": sure,
                "x": (box[0] + box[2]) / 2,
                "y": (box[1] + box[3]) / 2,
                **dict(zip(("x1", "y1", "x2", "y2"), box, strict=True)),
                "look": look,
            }
            for number, (label, score, sure, look, box) in enumerate(
                zip(*(column.tolist() for column in columns), strict=True)
            )
        ]

    def save(self, path: str | PathLike[str]) -> None:
        """Write the record to a safetensors file, atomically.

        Args:
            path: the file.

        Raises:
            DataError: the file cannot be written.
        """
        self._format.write(path, self._base(), *self._contents())

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

    def _base(self) -> Mapping[str, Any]:
        """The attributes that the files of all records keep."""
        return vars(self)

    @abstractmethod
    def _contents(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and JSON values of a file, beside those of the base."""

    @classmethod
    @abstractmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Make the other attributes from the tensors and JSON values of a file."""

    def to_frame(self, table: _Table = "looks") -> pandas.DataFrame:
        """A table of the record as a pandas data frame.

        Args:
            table: `looks`, the table of `rows`, or `objects`, that of `object_rows`.

        Returns:
            One row for each look or object.

        Raises:
            InputError: there is no such table, or pandas is not installed.
        """
        check(table in get_args(_Table), "table", "looks or objects", table)
        try:
            import pandas
        except ImportError:
            raise InputError(
                "pandas: expected the package to be installed, got none; run pip install pandas, or use rows()"
            ) from None
        rows, columns = (self.rows(), None) if table == "looks" else (self.object_rows(), _COLUMNS)
        return pandas.DataFrame(rows, columns=columns)

    def _detected(self, look: Detections) -> dict[str, Any]:
        """Columns of a table on the detections of a look: their number, and the most confident one."""
        count = int(look.count.sum())
        return {
            "detections": count,
            "seen": self.classes[int(look.labels.flatten()[0])] if count else None,
            "score": float(look.confidence.flatten()[0]) if count else None,
        }


@dataclass(frozen=True, kw_only=True, repr=False)
class GazeRecord(Record):
    """Base of the records of whole searches and explorations: the looks, the decision, and the reason for the end.

    `describe` and `why_it_ended` tell it in words. `plot`, `to_frame`, `as_fixations` and `save` make a picture,
    tables, fixations in the format of human data, and a file.

    Beside the attributes of `Record` it has those of its looks and of its end.

    Attributes:
        detections: detections of each look, batches of one.
        found: whether a search found its target.
        closer: closer looks of a search, in order.
        ending: reason for the end; None if it is not known.
        seconds: times of the looks; empty if they are not known.

    Example::

        record = agent.search("kitchen.jpg", "cup")
        print(record.summary())
        record.save("kitchen.safetensors")
    """

    detections: tuple[Detections, ...]
    found: bool = False
    closer: tuple[CloseUp, ...] = ()
    ending: Ending | None = None
    seconds: tuple[Any, ...] = ()

    how: ClassVar[Literal["fovea", "windows", "head"]]
    """Kind of look: of a fovea, at windows, or of a head that turns."""

    _sentences: ClassVar[Mapping[str, str]] = FIXATIONS

    def __len__(self) -> int:
        """Number of looks, the first included."""
        return len(self.detections)

    def __iter__(self) -> Iterator[RecordedLook]:
        """The looks in their order."""
        for number, (x, y) in enumerate(self._gaze()[0].tolist()):
            yield RecordedLook(
                number,
                (x, y),
                self.region(number),
                self._in_picture(number),
                self._duration(number),
                self._value(number),
            )

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture in pixels."""
        return self._gaze()[1]

    @property
    def passes(self) -> int:
        """Number of passes of the detector, closer looks included."""
        return len(self.detections) + len(self.closer)

    def region(self, number: int) -> tuple[float, float, float, float]:
        """Part of the picture that a look showed.

        Args:
            number: number of the look, from 0.

        Returns:
            `(x1, y1, x2, y2)` in picture pixels.
        """
        width, height = self.size
        return 0.0, 0.0, float(width), float(height)

    def _in_picture(self, number: int) -> Detections:
        """Detections of a look, with boxes in pixels of the picture."""
        return self.detections[number]

    def _duration(self, number: int) -> float | None:
        """Time that a look took."""
        return float(self.seconds[number]) if self.seconds else None

    def _value(self, number: int) -> float | None:
        """Value for which a look was chosen."""
        return None

    def _last(self) -> int:
        """Number of the last look."""
        return len(self) - 1

    @property
    def closer_looks(self) -> Sequence[CloseUp]:
        """The closer looks."""
        return self.closer

    def why_it_ended(self) -> str:
        """Explain in one sentence why the search or the exploration ended.

        Returns:
            The sentence; empty if the reason is not known.
        """
        if self.closer and self.found:
            return self._sentences["closer found"]
        outcome = None if self.decision is None else self.decision.outcome
        looks = self.passes if self.ending == "passes" else len(self)
        return sentence(self._sentences, self.ending, outcome, looks, closer=bool(self.closer))

    def summary(self) -> str:
        """Describe the outcome, and explain why the search or the exploration ended."""
        return f"{self.describe()}. {self.why_it_ended()}".rstrip()

    def as_fixations(self, picture: str, subject: str = "semfov") -> Fixations:
        """The fixations in the format of human data, to write with `semfov.data.fixations` or to compare by metrics.

        Args:
            picture: name of the picture.
            subject: name of the observer.

        Returns:
            The fixations, with the target of a search and whether it was found.
        """
        points, size = self._gaze()
        return Fixations(
            picture,
            subject,
            points.detach().double().cpu().numpy(),
            size,
            target=self.target_name,
            found=None if self.target is None else self.found,
        )

    def compare(
        self, people: Fixations | Sequence[Fixations] | str | PathLike[str]
    ) -> Mapping[str, tuple[float, float]]:
        """Compare the fixations with those of people in the same picture (`semfov.metrics.scanpath.compare_scanpath`).

        Args:
            people: their fixations, those of one person, or the path of a table (`semfov.data.fixations.read_table`).

        Returns:
            Each measure of this record and of the people among themselves; it prints as a table.
        """
        scores: Mapping[str, tuple[float, float]] = drawing_of("compare", type(self))(self, people)
        return scores

    @abstractmethod
    def _gaze(self) -> tuple[Tensor, tuple[int, int]]:
        """Fixated points `(n, 2)` in pixels of the picture, and its `(width, height)`."""


def detections_in_words(detections: Detections, classes: Sequence[str], most: int = 3, score: float = 0.0) -> str:
    """Name the most confident detections of a look.

    Args:
        detections: detections of one image, the most confident first.
        classes: names of the classes, background first.
        most: largest number of detections that are named.
        score: least confidence of the detections that count.

    Returns:
        The text.

    >>> import torch
    >>> cups = Detections(torch.zeros(1, 2, 4), torch.tensor([[[0.1, 0.9], [0.4, 0.6]]]), torch.ones(1, 2).bool())
    >>> detections_in_words(cups, ("background", "cup"), most=1), detections_in_words(cups, ("", "cup"), score=0.95)
    ('cup 0.90 and 1 more', 'nothing')
    """
    columns = (detections.labels, detections.confidence, detections.mask)
    looks = zip(*(column.flatten().tolist() for column in columns), strict=True)
    sure = [f"{classes[label]} {confidence:.2f}" for label, confidence, real in looks if real and confidence >= score]
    more = f" and {len(sure) - most} more" if len(sure) > most else ""
    return ", ".join(sure[:most]) + more or "nothing"
