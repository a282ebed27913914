"""The base of the records of what an agent looked at, detected and decided."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import fields as fields_of
from os import PathLike
from typing import TYPE_CHECKING, Any, ClassVar, Self

from torch import Tensor

from semfov.data.fixations import Fixations
from semfov.decision import CloseUp, Decision
from semfov.detection.detections import Detections
from semfov.errors import InputError
from semfov.paths.drawing import drawing_of
from semfov.paths.endings import FIXATIONS, Ending, sentence
from semfov.paths.files import Format

if TYPE_CHECKING:
    import pandas
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True, repr=False)
class Record(ABC):
    """Base of all records: what was looked for, and what was decided, in words and as a table.

    Attributes:
        classes: names of the classes, background first.
        target: class index 1..K that was searched for; None for all classes.
        decision: decision of a search; None for exploration, and for a search without one.

    Example::

        record = live.step(frame)
        print(record.describe(), record.rows())
    """

    classes: tuple[str, ...]
    target: int | None
    decision: Decision | None = None

    @property
    def target_name(self) -> str | None:
        """Name of the class that was searched for; None for all classes."""
        return None if self.target is None else self.classes[self.target]

    @abstractmethod
    def describe(self) -> str:
        """Describe the outcome in one line.

        Returns:
            The line.
        """

    def summary(self) -> str:
        """Describe the outcome, and explain why it ended if it did.

        Returns:
            A line of text.
        """
        return self.describe()

    def __repr__(self) -> str:
        """The summary, and lines about the looks."""
        return "\n".join([f"{type(self).__name__}: {self.summary()}", *(f"  {line}" for line in self._lines())])

    def _lines(self) -> list[str]:
        """Lines of the text form after the summary."""
        return []

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return str(drawing_of("notebook", type(self))(self))

    @abstractmethod
    def rows(self) -> list[dict[str, Any]]:
        """The looks as a table of plain values.

        Returns:
            One dictionary for each look.
        """

    def to_frame(self) -> pandas.DataFrame:
        """The table of `rows` as a pandas data frame.

        Returns:
            One row for each look.

        Raises:
            InputError: pandas is not installed.
        """
        try:
            import pandas
        except ImportError:
            raise InputError(
                "pandas: expected the package to be installed, got none; run pip install pandas, or use rows()"
            ) from None
        return pandas.DataFrame(self.rows())

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

    `describe` and `why_it_ended` tell it in words. `plot`, `to_frame`, `as_fixations` and `save` make a picture, a
    table, fixations in the format of human data, and a file.

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

    _format: ClassVar[Format]
    _sentences: ClassVar[Mapping[str, str]] = FIXATIONS

    def __len__(self) -> int:
        """Number of looks, the first included."""
        return len(self.detections)

    @property
    def passes(self) -> int:
        """Number of passes of the detector, closer looks included."""
        return len(self.detections) + len(self.closer)

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

    @property
    def image(self) -> Tensor | None:
        """The picture, `(3, h, w)` in [0, 1]; None if it was not kept."""
        return None

    def plot(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the looks on the picture.

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

    @abstractmethod
    def _gaze(self) -> tuple[Tensor, tuple[int, int]]:
        """Fixated points `(n, 2)` in pixels of the picture, and its `(width, height)`."""

    def save(self, path: str | PathLike[str]) -> None:
        """Write the record to a safetensors file, atomically.

        Args:
            path: the file.

        Raises:
            DataError: the file cannot be written.
        """
        self._format.write(path, vars(self), *self._parts())

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
    def _parts(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Tensors and JSON values of a file, beside those of the base."""

    @classmethod
    @abstractmethod
    def _fields(
        cls, tensors: Mapping[str, Tensor], record: Mapping[str, Any], shared: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Make the other attributes from the tensors and JSON values of a file.

        Args:
            tensors: all tensors.
            record: all JSON values.
            shared: attributes of the base.

        Returns:
            The attributes by name.

        Raises:
            InputError: they do not fit each other.
        """


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
    parts = (detections.labels, detections.confidence, detections.mask)
    looks = zip(*(part.flatten().tolist() for part in parts), strict=True)
    sure = [f"{classes[label]} {confidence:.2f}" for label, confidence, real in looks if real and confidence >= score]
    more = f" and {len(sure) - most} more" if len(sure) > most else ""
    return ", ".join(sure[:most]) + more or "nothing"
