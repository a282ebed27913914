"""Context: the places that a class is usually at, and the things that it is usually beside."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, ClassVar, Self

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.context_table import company_of, places_of, read_table
from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.errors import DataError, check, check_shape, lookup, values_known
from semfov.io import compatibility
from semfov.io.files import sha256
from semfov.io.pretrained import Pretrained
from semfov.io.schema import CLASSES, Array, Field, Number, Object, Pair, Schema


class ContextPrior(Pretrained):
    r"""Log odds that context adds to those of a target t in each cell x, from annotations alone.

    .. math:: c_t(x) = w_1 \, a_t(x) + w_2 \sum_{j \ne t} \sum_n q_{jn}(x) \, r_{tjn}

    with :math:`a_t(x)` the log odds that an object of t is at x, less those of its mean place, and

    .. math:: r_{tjn} = \ln \frac{P(t \in x \mid \text{the nearest } j \text{ lies in band } n \text{ of } x)}
              {P(t \in x)}

    how much likelier t is in a cell that has j at that distance, in a picture that holds both.
    :math:`q_{jn}(x)` is the probability that the nearest j lies in band n (`reaches`). Classes count as if they were
    independent, which they are not: the weights w, fitted together with the belief that the context is added to, make
    up for it. (Context by place and by company: Torralba, 2003; Galleguillos and Belongie, 2010.)

    Args:
        classes: names of the K classes, without background.
        place: `(K+1, R, R)`, a; the map is stretched over the image, whatever its grid.
        cooccurrence: `(K+1, K+1, N)`, r: target, other class, band.
        edges: upper borders of all bands but the last, ascending, in longer sides of the image.
        weights: `(w_1, w_2)` by the kind of belief, `evidence` (`TargetEvidence`) or `map` (a class posterior).
        metadata: JSON values kept with the model.

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
        check(list(edges) == sorted(edges) and min(edges, default=0) >= 0, "edges", "ascending, from 0", edges)
        self.classes = tuple(classes)
        self.edges = tuple(edges)
        self.weights = {kind: (float(pair[0]), float(pair[1])) for kind, pair in (weights or {}).items()}
        self.metadata = dict(metadata or {})
        self.register_buffer("place", place)
        self.register_buffer("cooccurrence", cooccurrence)

    def forward(
        self, presence: Tensor, grid: Grid, target: int | Tensor, weights: tuple[float, float] = (1.0, 1.0)
    ) -> Tensor:
        """Log odds to add in each cell, `(B, X·Y)`.

        Args:
            presence: `(B, X·Y, K+1)`, probability of each class in each cell (`presence_of`, or the means of a map).
            grid: the cells of one image.
            target: class 1..K, or `(B,)` with one for each belief.
            weights: of place and of co-occurrence.
        """
        index = torch.as_tensor(target, device=presence.device)
        components = len(self.classes) + 1
        check_shape(presence, "presence", None, len(grid), components)
        if values_known(index):
            inside = bool(((index >= 1) & (index < components)).all())
            check(inside, "target", f"a class from 1 to {components - 1}", target)
        place, company = weights
        value = presence.new_zeros(presence.shape[:2])
        if place:
            value = value + place * self.place_at(grid)[index].to(presence)
        if company:
            ratio = self.cooccurrence[index.expand(len(presence))].to(presence)
            nearer = torch.zeros_like(presence)
            for band, reach in enumerate(reaches(presence, grid, self.edges)):
                value = value + company * ((reach - nearer) @ ratio[:, :, band, None])[..., 0]
                nearer = reach
        return value

    def place_at(self, grid: Grid) -> Tensor:
        """The map of places at the centres of a grid's cells, by bilinear interpolation, `(K+1, X·Y)`."""
        size = grid.rows, grid.columns
        return F.interpolate(self.place[:, None], size, mode="bilinear", align_corners=False).flatten(1)

    def weights_for(self, kind: str) -> tuple[float, float]:
        """Fitted weights of place and co-occurrence beside a belief of this kind; InputError for an unknown one."""
        return self.weights[lookup(kind, self.weights, "kind of belief")]

    def check_compatible(self, classes: Sequence[str]) -> None:
        """Raise `InputError` unless a detector with these classes can be used."""
        compatibility.check_classes(self.classes, classes, self.title)

    def digest(self) -> str:
        """sha256 of all that `forward` and `weights_for` depend on."""
        what = json.dumps([self.classes, self.edges, self.weights, self.metadata], sort_keys=True).encode()
        tensors = [tensor.cpu().contiguous().view(torch.uint8).numpy().tobytes() for tensor in self.buffers()]
        return hashlib.sha256(b"".join([what, *tensors])).hexdigest()

    def _record(self) -> dict[str, Any]:
        """Classes, bands and weights."""
        return {"classes": self.classes, "edges": self.edges, "weights": self.weights}

    def _tensors(self) -> dict[str, Tensor]:
        """Both tables in half precision."""
        return {name: tensor.half() for name, tensor in self.state_dict().items()}

    @classmethod
    def _restore(cls, record: Mapping[str, Any], tensors: dict[str, Tensor]) -> Self:
        """The prior from what was kept."""
        tables = tensors["place"].float(), tensors["cooccurrence"].float()
        settings = {"weights": record["weights"], "metadata": record["metadata"]}
        return cls(record["classes"], *tables, record["edges"], **settings)

    def permuted(self, seed: int = 0) -> "ContextPrior":
        """The same tables with the classes exchanged at random: a control that knows as much, of the wrong things."""
        generator = torch.Generator().manual_seed(seed)
        order = torch.cat(
            [torch.zeros(1, dtype=torch.long), 1 + torch.randperm(len(self.classes), generator=generator)]
        )
        tables = self.place[order], self.cooccurrence[order][:, order]
        metadata = {**self.metadata, "permuted": seed}
        return ContextPrior(self.classes, *tables, self.edges, weights=self.weights, metadata=metadata)

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
        r"""Context from any table of classes by classes: from language, from a person, from another data set.

        .. math:: r_{tjn} = b_n \bigl(v_{tj} - \bar v_{t\cdot} - \bar v_{\cdot j} + \bar v\bigr), \qquad
                  b_n = 1 - \frac{2 n}{N - 1}

        with v the table's value of class j beside a target t, on any scale, the larger the more they belong together.
        It counts by comparison alone, with what either class has beside others; so does a place with others of its
        class. What is unknown counts nothing. How much the table should count is another matter: `train.fit_context`
        fits the weights, which are 1 here.

        Args:
            path: CSV with the names of other classes in its first row, and of targets in its first column; an empty
                cell is unknown.
            classes: names of the detector's classes; the table's are matched to them by name, in any spelling, or by
                their synonyms (`semfov.data.naming.alike`).
            source: where the table comes from; it is kept in the metadata, with the table's sha256.
            places: CSV with the names of classes in its first column, and how likely they are at each height of a
                picture, as log odds from the top row to the bottom one; None knows of no places.
            sha256: that the table must have.
            edges: upper borders of all bands of distance but the last, in longer sides of the image.

        Raises:
            DataError: a file is missing, no such table, or not the one of the checksum.
            InputError: it knows none of the classes, or an argument does not fit.
        """
        check(bool(source.strip()), "source", "where the table comes from", repr(source))
        digest = _digest(path)
        if sha256 is not None and sha256.lower() != digest:
            raise DataError(f"{path}: expected a table with sha256 {sha256}, got {digest}; fetch it again")
        company, missing = company_of(read_table(path), classes, len(edges) + 1)
        place = torch.zeros(len(classes) + 1, 1, 1)
        told: dict[str, Any] = {"source": source, "sha256": digest, "missing": missing}
        if places is not None:
            place = places_of(read_table(places), classes)
            told["places_sha256"] = _digest(places)
        weights = dict.fromkeys(("evidence", "map"), (1.0, 1.0))
        return cls(classes, place, company, edges, weights=weights, metadata={"table": told})

    @classmethod
    def from_pretrained(cls, name_or_path: str | PathLike[str] = "coco") -> Self:
        """A prior that is shipped with the package, by name, or one that `save` wrote, by path; in `eval` mode.

        Raises:
            InputError: no prior of that name is shipped.
            DataError: the file is missing, damaged or not such a prior.
        """
        return super().from_pretrained(name_or_path)


def _digest(path: str | PathLike[str]) -> str:
    try:
        return sha256(Path(path))
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error


def presence_of(detections: Detections, grid: Grid) -> Tensor:
    """Highest score of each class among the detections that overlap a cell, `(B, X·Y, K+1)`, 0 where there are none."""
    batch, count, components = detections.scores.shape
    seen = detections.scores.new_zeros(batch, len(grid), components)
    covered = grid.footprint(detections.boxes) & detections.mask[..., None]
    for index in range(count):
        seen = torch.maximum(seen, covered[:, index, :, None] * detections.scores[:, index, None])
    return seen


def reaches(presence: Tensor, grid: Grid, edges: Sequence[float]) -> Iterator[Tensor]:
    r"""Probability of each class no farther from a cell than each edge, then anywhere: N tensors `(B, X·Y, C)`.

    .. math:: R_{jn}(x) = \max_{y : d(x, y) \le e_n} p_j(y), \qquad q_{jn} = R_{jn} - R_{j,n-1}

    with d the larger of the horizontal and the vertical distance between the cells' centres, in longer sides of the
    image. The largest rather than one minus the product: neighbouring cells show one and the same object.

    Args:
        presence: `(B, X·Y, C)`, p.
        grid: the cells of one image.
        edges: e, ascending.
    """
    check(grid.extent.ndim == 1, "grid", "the size of one image", grid.size)
    planes = presence.transpose(1, 2).unflatten(-1, (grid.rows, grid.columns))
    width, height = (float(side) / max(map(float, grid.size)) for side in grid.size)
    for edge in edges:
        # Rounding must not take cells out that lie just at the edge.
        across = min(int(edge * grid.columns / width + 1e-6), grid.columns - 1)
        down = min(int(edge * grid.rows / height + 1e-6), grid.rows - 1)
        pooled = F.max_pool2d(planes, (2 * down + 1, 2 * across + 1), 1, (down, across))
        yield pooled.flatten(2).transpose(1, 2)
    yield presence.amax(1, keepdim=True).expand_as(presence)
