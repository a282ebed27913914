"""Context: the usual places of a class in the image, and the classes that it usually occurs with."""

from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.context_table import cooccurrence_from, places_from, read_named_table
from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.errors import DataError, check, check_shape, lookup, values_known
from semfov.io import compatibility
from semfov.io.files import sha256
from semfov.io.pretrained import Pretrained
from semfov.io.schema import CLASSES, Array, Field, Number, Object, Pair, Schema

_TABLE_WEIGHTS = (0.1, 0.2)
"""Weights of place and co-occurrence in a context from a table: the better of two pairs on 40 photographs."""


class ContextPrior(Pretrained):
    r"""Log odds that context adds to a belief about a target t in each cell x; learned from annotations alone.

    .. math:: c_t(x) = w_1 \, a_t(x) + w_2 \sum_{j \ne t} \sum_n q_{jn}(x) \, r_{tjn}

    The first term is the place: :math:`a_t(x)` are the log odds that an object of t is at x, minus their mean over the
    image. The second term is co-occurrence. In a picture that holds t and j,

    .. math:: r_{tjn} = \ln \frac{P(t \in x \mid \text{the nearest } j \text{ lies in band } n \text{ of } x)}
              {P(t \in x)}

    says how much likelier t is in a cell with j at that distance; :math:`q_{jn}(x)` is the probability that the nearest
    j lies in band n (`reaches`). The sum treats classes as independent, which they are not. The weights w compensate
    for it, and suit one kind of belief. (Context by place and by co-occurrence: Torralba, 2003; Galleguillos and
    Belongie, 2010.)

    Args:
        classes: names of the K classes, without background.
        place: `(K+1, R, R)`, a; the map is interpolated over the image, for any grid.
        cooccurrence: `(K+1, K+1, N)`, r: target, other class, band of distance.
        edges: N - 1 upper borders of the bands, ascending, in longer sides of the image; the last band is open.
        weights: `(w_1, w_2)` for each kind of belief, `evidence` (`TargetEvidence`) or `map` (a class posterior).
        metadata: JSON values saved with the model.

    Raises:
        InputError: a shape does not fit, or `edges` are not ascending.

    >>> place = torch.zeros(3, 2, 2)
    >>> place[1, 1] = 1.0  # cups are in the lower half
    >>> prior = ContextPrior(["cup", "table"], place, torch.zeros(3, 3, 2), [0.1])
    >>> prior(torch.zeros(1, 4, 3), Grid(2, 2, (10, 10)), 1)
    tensor([[0., 0., 1., 1.]])
    """

    kind: ClassVar[str] = "context-prior"
    title: ClassVar[str] = "context prior"
    shipped: ClassVar[Path] = Path(__file__).parent / "models" / "context"
    schema: ClassVar[Schema] = Schema(
        {
            "place": Field(("K+1", "R", "R"), torch.float16, low=-1e3, high=1e3),
            "cooccurrence": Field(("K+1", "K+1", "N"), torch.float16, low=-1e3, high=1e3),
        },
        {
            "classes": CLASSES,
            "edges": Array(Number(0, 100), "N-1", ascending=True),
            "weights": Object(others=Pair((Number(-100, 100), Number(-100, 100)))),
        },
    )
    place: Tensor
    cooccurrence: Tensor

    def __init__(
        self,
        classes: Sequence[str],
        place: Tensor,
        cooccurrence: Tensor,
        edges: Sequence[float],
        *,
        weights: Mapping[str, tuple[float, float]] | None = None,
        metadata: Mapping[str, Any] | None = None,
    ) -> None:
        super().__init__()
        components = len(classes) + 1
        check_shape(place, "place", components, place.shape[-1], place.shape[-1])
        check_shape(cooccurrence, "cooccurrence", components, components, len(edges) + 1)
        check(
            list(edges) == sorted(edges) and min(edges, default=0) >= 0, "edges", "ascending numbers, 0 or more", edges
        )
        self.classes = tuple(classes)
        self.edges = tuple(edges)
        self.weights = {kind: (float(pair[0]), float(pair[1])) for kind, pair in (weights or {}).items()}
        self.metadata = dict(metadata or {})
        self.register_buffer("place", place)
        self.register_buffer("cooccurrence", cooccurrence)

    def forward(
        self, presence: Tensor, grid: Grid, target: int | Tensor, weights: tuple[float, float] = (1.0, 1.0)
    ) -> Tensor:
        """Log odds to add in each cell.

        Args:
            presence: `(B, X·Y, K+1)`, probability of each class in each cell (`presence_of`, or the means of a map).
            grid: the cells of one image.
            target: class 1..K, or `(B,)` with one class for each belief.
            weights: of place and of co-occurrence.

        Returns:
            `(B, X·Y)`.

        Raises:
            InputError: the shape of `presence` does not fit, or a class is out of range.
        """
        index = torch.as_tensor(target, device=presence.device)
        components = len(self.classes) + 1
        check_shape(presence, "presence", None, len(grid), components)
        if values_known(index):
            inside = bool(((index >= 1) & (index < components)).all())
            check(inside, "target", f"a class from 1 to {components - 1}", target)
        place_weight, cooccurrence_weight = weights
        value = presence.new_zeros(presence.shape[:2])
        if place_weight:
            value = value + place_weight * self.place_at(grid)[index].to(presence)
        if cooccurrence_weight:
            ratio = self.cooccurrence[index.expand(len(presence))].to(presence)
            nearer = torch.zeros_like(presence)
            for band, reach in enumerate(reaches(presence, grid, self.edges)):
                value = value + cooccurrence_weight * ((reach - nearer) @ ratio[:, :, band, None])[..., 0]
                nearer = reach
        return value

    def place_at(self, grid: Grid) -> Tensor:
        """Interpolate the map of places at the centres of the cells, bilinearly.

        Args:
            grid: the cells of one image.

        Returns:
            `(K+1, X·Y)`, log odds.
        """
        size = grid.rows, grid.columns
        return F.interpolate(self.place[:, None], size, mode="bilinear", align_corners=False).flatten(1)

    def weights_for(self, kind: str) -> tuple[float, float]:
        """Weights of place and co-occurrence for a kind of belief.

        Args:
            kind: `evidence` or `map`.

        Returns:
            The two weights.

        Raises:
            InputError: there are no weights for this kind.
        """
        return self.weights[lookup(kind, self.weights, "kind of belief")]

    def check_compatible(self, classes: Sequence[str]) -> None:
        """Check that the prior was made for the classes of a detector.

        Args:
            classes: names of the K classes.

        Raises:
            InputError: the names differ.
        """
        compatibility.check_classes(self.classes, classes, self.title)

    def _record(self) -> dict[str, Any]:
        """The classes, the bands and the weights."""
        return {"classes": self.classes, "edges": self.edges, "weights": self.weights}

    def _tensors(self) -> dict[str, Tensor]:
        """Both tables in half precision."""
        return {name: tensor.half() for name, tensor in super()._tensors().items()}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The prior with the saved tensors and record."""
        tables = tensors["place"].float(), tensors["cooccurrence"].float()
        settings = {"weights": record["weights"], "metadata": record["metadata"]}
        return cls(record["classes"], *tables, record["edges"], **settings)

    @classmethod
    def from_table(
        cls,
        path: str | PathLike[str],
        classes: Sequence[str],
        *,
        source: str,
        places: str | PathLike[str] | None = None,
        sha256: str | None = None,
        edges: Sequence[float] = (0.0, 0.15, 0.35),
    ) -> Self:
        r"""Make a prior from a table of classes by classes, for example from a language model or another data set.

        .. math:: r_{tjn} = b_n \bigl(v_{tj} - \bar v_{t\cdot} - \bar v_{\cdot j} + \bar v\bigr), \qquad
                  b_n = 1 - \frac{2 n}{N - 1}

        The value v of a target t and another class j may have any scale; larger values mean that the classes belong
        together. Only differences count: a value is compared with the other values of either class, and a place with
        the other places of its class. Unknown values count as 0 after this comparison. The weights of place and
        co-occurrence are `_TABLE_WEIGHTS`.

        Args:
            path: CSV file with the names of other classes in the first row and of targets in the first column; an
                empty cell is unknown.
            classes: names of the detector's classes; names in the table are matched to them in any spelling, or by
                their synonyms (`semfov.data.classes.alike`).
            source: where the table comes from; it is saved in the metadata, with the sha256 of the table.
            places: CSV file with the names of classes in the first column, and the log odds of the class at each
                height of a picture, from the top row to the bottom row; None uses no places.
            sha256: expected checksum of the table; None does not check it.
            edges: N - 1 upper borders of the bands of distance, in longer sides of the image.

        Returns:
            The prior.

        Raises:
            DataError: a file is missing, is not such a table, or has another checksum.
            InputError: the table has none of the classes, or an argument does not fit.
        """
        check(bool(source.strip()), "source", "a text that says where the table comes from", repr(source))
        digest = _digest(path)
        if sha256 is not None and sha256.lower() != digest:
            raise DataError(f"{path}: expected a table with sha256 {sha256}, got {digest}; download it again")
        cooccurrence, missing = cooccurrence_from(read_named_table(path), classes, len(edges) + 1)
        place = torch.zeros(len(classes) + 1, 1, 1)
        origin: dict[str, Any] = {"source": source, "sha256": digest, "missing": missing}
        if places is not None:
            place = places_from(read_named_table(places), classes)
            origin["places_sha256"] = _digest(places)
        weights = dict.fromkeys(("evidence", "map"), _TABLE_WEIGHTS)
        return cls(classes, place, cooccurrence, edges, weights=weights, metadata={"table": origin})

    @classmethod
    def from_pretrained(cls, name_or_path: str | PathLike[str] = "coco") -> Self:
        """Load a prior: one shipped with the package, by its name, or a file that `save` wrote, by its path.

        Args:
            name_or_path: name of a shipped prior, or path of a `.safetensors` file.

        Returns:
            The prior, in `eval` mode.

        Raises:
            InputError: no prior of that name is shipped.
            DataError: the file is missing or damaged, or holds no context prior.
        """
        return super().from_pretrained(name_or_path)


def _digest(path: str | PathLike[str]) -> str:
    try:
        return sha256(Path(path))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def presence_of(detections: Detections, grid: Grid) -> Tensor:
    """Highest score of each class among the detections that overlap a cell, `(B, X·Y, K+1)`; 0 without detections."""
    batch, count, components = detections.scores.shape
    presence = detections.scores.new_zeros(batch, len(grid), components)
    covered = grid.footprint(detections.boxes) & detections.mask[..., None]
    for index in range(count):
        presence = torch.maximum(presence, covered[:, index, :, None] * detections.scores[:, index, None])
    return presence


def reaches(presence: Tensor, grid: Grid, edges: Sequence[float]) -> Iterator[Tensor]:
    r"""Probability that each class occurs within a distance of every cell, for each distance in `edges`.

    .. math:: R_{jn}(x) = \max_{y : d(x, y) \le e_n} p_j(y), \qquad q_{jn} = R_{jn} - R_{j,n-1}

    d is the larger of the horizontal and the vertical distance between the centres of the cells, in longer sides of the
    image. The maximum is used instead of one minus the product because neighbouring cells often show the same object.

    Args:
        presence: `(B, X·Y, C)`, p.
        grid: the cells of one image.
        edges: N - 1 borders e, ascending, in longer sides of the image.

    Yields:
        R for each edge, and last for the whole image: N tensors `(B, X·Y, C)`.

    Raises:
        InputError: the grid has a batch of sizes.

    >>> presence = torch.tensor([[[0.9], [0.0], [0.0]]])  # three cells in a row, one class
    >>> for reach in reaches(presence, Grid(3, 1, (30, 10)), edges=[0.4]):
    ...     print(reach[0, :, 0])
    tensor([0.9000, 0.9000, 0.0000])
    tensor([0.9000, 0.9000, 0.9000])
    """
    check(grid.extent.ndim == 1, "grid", "the size of one image", grid.size)
    planes = presence.transpose(1, 2).unflatten(-1, (grid.rows, grid.columns))
    width, height = (float(side) / max(map(float, grid.size)) for side in grid.size)
    for edge in edges:
        # The small addition keeps rounding from excluding cells exactly at the edge.
        across = min(int(edge * grid.columns / width + 1e-6), grid.columns - 1)
        down = min(int(edge * grid.rows / height + 1e-6), grid.rows - 1)
        pooled = F.max_pool2d(planes, (2 * down + 1, 2 * across + 1), 1, (down, across))
        yield pooled.flatten(2).transpose(1, 2)
    yield presence.amax(1, keepdim=True).expand_as(presence)
