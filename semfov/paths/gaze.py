"""The record of where people look in a picture: a density with its terms, and scanpaths drawn from it."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, get_args

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.attribute_words import GAZE_PREDICTION, OtherWords
from semfov.data.classes import amount
from semfov.data.fixations import Fixations
from semfov.detection import Detector, FeatureMaps
from semfov.errors import InputError, check, check_number, check_whole, checked_keywords, lookup
from semfov.eye import Eye
from semfov.gaze.saliency.fixation_density import FixationDensity, density_for
from semfov.gaze.saliency.glimpses import features_so_far
from semfov.gaze.saliency.on_picture import interpolation
from semfov.gaze.saliency.views import picture_terms
from semfov.io.files import MADE_HERE, write_bytes
from semfov.kinds import Quality
from semfov.paths.areas import Area, AreasLike, percent, read_areas, share_in
from semfov.paths.base import Record
from semfov.paths.cautions import Cautions
from semfov.paths.places import Place, are_apart, places_of
from semfov.paths.stimulus import reduced_copy
from semfov.paths.viewed import ScanpathLike, fixations_of
from semfov.paths.viewers import AreaVisits, drawn_durations, drawn_starts, visits_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_VIEWERS = 100  # whose first fixations, and first visits of areas, are counted
_MOST_FIRST = 10  # first fixations that can be asked for
_BLANK = 2  # largest difference of bytes in a picture of one colour
_ROUND = 1.5  # least width over height of a panorama


@dataclass(frozen=True, repr=False, eq=False)
class GazePrediction(OtherWords):
    """Prediction of where people look in a picture, if they view it freely, without a task.

    Attributes:
        model: the model. All predictions share the shipped one: copy it before you change it.
        terms: its terms for this picture (`FixationDensity.terms`).
        size: `(width, height)` of the picture in pixels.
        photograph: `(3, h, w)`, bytes, the reduced picture.
        source: file of the picture; None if it does not come from a file.
        seen: number of fixations from which the fovea has seen the picture; None for the sharp picture.
        is_shipped: whether the model is the one that is shipped for the detector.
        unlikeness: distance of the picture from those of the fit; from 1 on it counts as unlike them
            (`semfov.gaze.saliency.PictureLikeness`). None if it is not known.
        panorama: whether the left and the right edge of the picture meet.

    Example::

        gaze = agent.gaze("poster.jpg")
        gaze.peaks()[0]  # where most fixations are expected
        gaze.scanpaths(15, seconds=3.0)
        gaze.report("poster.html")
    """

    model: FixationDensity
    terms: Mapping[str, Tensor]
    size: tuple[int, int]
    photograph: Tensor
    source: str | None = None
    seen: int | None = None
    is_shipped: bool = False
    unlikeness: float | None = None
    panorama: bool = False

    _other_words = GAZE_PREDICTION

    @classmethod
    def of(
        cls,
        looking: Detector | Eye,
        image: Tensor,
        *,
        model: FixationDensity | str | PathLike[str] | None = None,
        source: str | None = None,
        size: tuple[int, int] | None = None,
        seen: ScanpathLike | None = None,
        quality: Quality = "quick",
        panorama: bool = False,
    ) -> Self:
        """Predict where people look in a picture, from one pass of a detector, or from several.

        Args:
            looking: the detector, or an eye with it.
            image: `(3, H, W)`, RGB in [0, 1].
            model: a model that was fitted to the detector, or its file or folder; None for the one that is shipped.
            source: file of the picture.
            size: `(width, height)` of the picture, of which `image` may be a reduced copy; None for that of `image`.
            seen: fixations or a record, in any size of the picture, or points in its pixels: the prediction then uses
                only what the fovea shows at them. None for the sharp picture.
            quality: `quick`, one pass; or `best`, six passes, over windows and a mirror image, too.
            panorama: whether it is a panorama of 360°, whose left and right edge meet. The detector gets it in four
                windows all around, or more if it is a narrow strip (`best`: twice as many), and there is no centre
                bias.

        Returns:
            The prediction.

        Raises:
            InputError: no model is shipped for the detector, or the given one was fitted to another detector; the
                fixations of `seen` are not those of one viewer of this picture, or the sensor of the eye bends it; or
                `quality`, `panorama` and `seen` do not go together.
            DataError: the file of the model is missing or damaged.
        """
        detector = looking.detector if isinstance(looking, Eye) else looking
        fitted = density_for(detector, model)
        size_of_image = int(image.shape[-1]), int(image.shape[-2])
        size = size or size_of_image
        lookup(quality, get_args(Quality), "quality")
        is_wide = size[0] >= _ROUND * size[1]
        check(is_wide or not panorama, "panorama", "a picture that is at least 1.5 times as wide as high", size)
        converted = _converted(fitted, image)
        fixations = None
        unlikeness = None  # what a fovea has shown is unlike a sharp picture, whatever the picture is
        with torch.no_grad():
            if seen is None:
                terms, unlikeness = picture_terms(detector, image, converted, quality=quality, panorama=panorama)
            else:
                eye = _fovea_of(looking, quality, panorama)
                fixations = fixations_of(seen, "seen", size, source)
                features = _foveal_features(eye, image, fixations.resized(size_of_image), fitted)
                terms = converted.terms(features, size[::-1])
        on_processor = {name: term.cpu() for name, term in terms.items()}
        photograph = reduced_copy(image)
        if _is_blank(photograph):
            # Only the padding around the picture would make a map.
            on_processor["map"] = torch.zeros_like(on_processor["map"])
        return cls(
            fitted,
            on_processor,
            size,
            photograph,
            source,
            None if fixations is None else len(fixations),
            is_shipped=model is None,
            unlikeness=unlikeness,
            panorama=panorama,
        )

    @property
    def unlike(self) -> bool:
        """Whether the picture is unlike the pictures of the fit, as pages, charts and drawings are."""
        return self.unlikeness is not None and self.unlikeness > 1

    @property
    def caution(self) -> str | None:
        """Why the prediction may be wrong for this picture; None if there is no reason."""
        blank = _is_blank(self.photograph)
        return Cautions(self.size, self.unlike, blank, self.panorama, self.is_shipped).words()

    @cached_property
    def density(self) -> Tensor:
        """Probability of a fixation in each pixel of the picture, `(H, W)`, with sum 1."""
        return self._over_pixels(self._log())

    @cached_property
    def cells(self) -> Tensor:
        """Probability of a fixation in each cell, `(rows, columns)`, 52 along the longer side, with sum 1."""
        log = self._log()
        return (log - log.logsumexp((0, 1))).exp()

    @property
    def entropy(self) -> float:
        """Entropy of the density over the cells, in bits; at most the logarithm of their number."""
        return float(-torch.xlogy(self.cells, self.cells).sum() / math.log(2))

    @property
    def parts(self) -> dict[str, float]:
        """Effect of each term on the density: divergence, in bits, from the density without the term."""
        log_density = self.cells.log()  # (rows, columns)
        parts = {}
        for name in self.terms:
            others = (term[0] for other, term in self.terms.items() if other != name)
            without = sum(others, torch.zeros_like(log_density))
            # The sum of the other terms is a log density up to a constant, which is subtracted.
            log_ratio = log_density - without + without.logsumexp((0, 1))
            parts[name] = float((self.cells * log_ratio).sum() / math.log(2))
        return parts

    def peaks(self, count: int = 5) -> list[dict[str, float]]:
        """List the places where most fixations are expected, the most likely first.

        Args:
            count: largest number of places.

        Returns:
            For each place `x` and `y` in pixels of the picture, and `share`, the probability of a fixation within 5 %
            of the longer side around it. Places are ordered by their share, and at least twice this distance apart. A
            smaller `count` gives the first places of a larger one.

        Raises:
            InputError: `count` is out of range.
        """
        check_whole(count, "count", 1, 100)
        return [{**place} for place in self._places[:count]]  # copies, which a caller may change

    @cached_property
    def _places(self) -> list[Place]:
        """All places, as `peaks` orders them."""
        return places_of(self.cells, self.size, around=self.panorama)

    def first_fixations(self, count: int = 3) -> list[dict[str, float]]:
        """List where people look first, in order.

        A viewer's eyes are in the middle when the picture appears. For each later fixation, the list has the place that
        most of 100 simulated viewers fixate, unless it is in the list already.

        Args:
            count: number of fixations, from 1 to 10.

        Returns:
            For each fixation `x` and `y` in pixels of the picture, and `share`, the share of the viewers whose fixation
            of this number is within 5 % of the longer side around it.

        Raises:
            InputError: `count` is out of range.
        """
        check_whole(count, "count", 1, _MOST_FIRST)
        viewers = self._viewers(count) if len(self._first) < count else []
        while len(self._first) < count:
            cells = self.given(viewers, len(self._first) + 1)
            places = places_of(cells, self.size, around=self.panorama)
            new = [place for place in places if are_apart(place, self._first, self.size, around=self.panorama)]
            self._first.append(new[0] if new else places[0])
        return [{**place} for place in self._first[:count]]

    @cached_property
    def _first(self) -> list[Place]:
        """The first fixations that were asked for so far."""
        return []

    def _viewers(self, fixations: int) -> list[Fixations]:
        """Draw viewers whose first fixations stand for those of all people; the same ones at each call."""
        generator = torch.Generator().manual_seed(0)
        start = drawn_starts(self.model, self._log(), self.size, _VIEWERS, generator)
        paths = self.model.sample(self.terms, self.size[::-1], start, fixations, generator)
        return [Fixations(self.name, f"viewer {n}", path.double().numpy(), self.size) for n, path in enumerate(paths)]

    def share(self, areas: AreasLike) -> dict[str, float]:
        """Compute for each area of interest the share of all fixations that lie in it.

        Args:
            areas: boxes by name, as left, top, right and bottom edge in pixels of the picture; a text such as
                `logo:10,20,200,80 price:300,40,420,90`; or a JSON file, `{"logo": [10, 20, 200, 80]}`. If the areas lie
                elsewhere in each picture, a mapping from the picture's name to its boxes by name.

        Returns:
            The shares by name, from 0 to 1. Areas that overlap share fixations.

        Raises:
            InputError: an area has another form, is empty or reaches out of the picture.
            DataError: the file cannot be read.

        Example::

            agent.gaze("poster.jpg").share({"logo": (10, 20, 200, 80)})  # {'logo': 0.07}
        """
        return {name: share_in(self.density, area) for name, area in self.areas(areas).items()}

    def visits(self, areas: AreasLike, *, seconds: float = 3.0) -> dict[str, AreaVisits]:
        """Compute how many of 100 simulated viewers see each area of interest at least once, and after which time.

        Args:
            areas: as for `share`.
            seconds: time for which each views the picture.

        Returns:
            The share of viewers and the median time to their first fixation, by the name of the area.

        Raises:
            InputError: an area has another form or reaches out of the picture, or `seconds` is out of range.
            DataError: the file cannot be read.

        Example::

            agent.gaze("poster.jpg").visits({"logo": (10, 20, 200, 80)})["logo"].viewers  # 0.36
        """
        boxes = self.areas(areas)
        check_number(seconds, "seconds", 0.1, 60.0)
        if seconds not in self._viewing:
            self._viewing[seconds] = self.scanpaths(_VIEWERS, seconds=seconds)
        viewers = self._viewing[seconds]
        pause = float(self.model.pause)
        return {name: visits_of(viewers, area, pause) for name, area in boxes.items()}

    @cached_property
    def _viewing(self) -> dict[float, list[Fixations]]:
        """The viewers whose visits of areas are counted, by the seconds for which they view the picture."""
        return {}

    def areas(self, areas: AreasLike) -> dict[str, Area]:
        """Read areas of interest in this picture, and check that they lie in it.

        Args:
            areas: as for `share`.

        Returns:
            The areas by name.
        """
        return read_areas(areas, self.size, [self.name, self.source or self.name])

    @checked_keywords
    def scanpaths(self, people: int = 15, *, seconds: float = 3.0, seed: int = 0) -> list[Fixations]:
        """Draw scanpaths of viewers.

        Durations and pauses are drawn from the distributions of the people of the fit; first fixations from the
        distribution of their first fixations, times the density of this picture.

        Args:
            people: number of viewers.
            seconds: time for which each views the picture.
            seed: seed of all draws.

        Returns:
            A record for each viewer, in pixels of the picture to a hundredth, with durations in whole milliseconds.

        Raises:
            InputError: an argument is out of range.
        """
        check_whole(people, "people", 1, 10_000)
        check_number(seconds, "seconds", 0.1, 60.0)
        generator = torch.Generator().manual_seed(seed)
        start = drawn_starts(self.model, self._log(), self.size, people, generator)
        durations, lengths = drawn_durations(self.model, people, seconds, generator)
        paths = self.model.sample(self.terms, self.size[::-1], start, int(lengths.max()), generator)
        viewers = []
        for number, (path, length, times) in enumerate(zip(paths, lengths.tolist(), durations, strict=True), 1):
            points = path[:length].double().numpy()
            # Rounding to a hundredth puts none of them on the far edge.
            points = np.minimum(points, np.array(self.size) - 0.51).round(2)
            spent = times[:length].double().round().numpy()
            viewers.append(Fixations(self.name, f"viewer {number}", points, self.size, spent))
        return viewers

    @property
    def name(self) -> str:
        """Name of the picture's file, or its size."""
        return Path(self.source).name if self.source else f"{self.size[0]} × {self.size[1]} px"

    @property
    def image(self) -> Tensor:
        """The reduced picture, `(3, h, w)` in [0, 1]."""
        return self.photograph.float() / 255

    def given(self, scanpaths: Sequence[Fixations], number: int) -> Tensor:
        """Predict the density of viewers' next fixation after `number` fixations, as a mean over viewers.

        Args:
            scanpaths: their scanpaths; those that are shorter are left out.
            number: number of fixations so far, at least 1.

        Returns:
            `(rows, columns)`; the density of all fixations where no scanpath is long enough.
        """
        candidates = [scanpath.resized(self.size) for scanpath in scanpaths if len(scanpath) >= number]
        if not candidates:
            return self.cells
        points = [torch.from_numpy(scanpath.points[:number]) for scanpath in candidates]
        with torch.no_grad():
            terms = self.model.given(self.terms, self.size[::-1], torch.stack(points).float())  # points (n, number, 2)
        # Terms are summands of a logarithm, (n, rows, columns) each.
        log_density = torch.stack([*terms.values()]).sum(0).flatten(1)
        return log_density.softmax(1).mean(0).view_as(self.cells)

    def next_density(self, scanpath: ScanpathLike) -> Tensor:
        """Predict the probability of a viewer's next fixation in each pixel, after the fixations so far.

        As for `density`, the prediction uses the whole sharp picture, or with `agent.gaze(picture, seen=scanpath)` what
        a fovea shows at these fixations.

        Args:
            scanpath: the fixations so far, or a record, in any size of the picture, or points in its pixels.

        Returns:
            `(H, W)`, with sum 1.

        Raises:
            InputError: they are not the fixations of one viewer of this picture.
        """
        viewed = fixations_of(scanpath, "scanpath", self.size, self.source)
        return self._over_pixels(self.given([viewed], len(viewed)).log())

    def compare(
        self, people: Fixations | Record | Sequence[Fixations | Record] | str | PathLike[str]
    ) -> dict[str, float]:
        """Compare the density with fixations of people in the same picture, all but the first of each person.

        Args:
            people: their fixations, in any size of the picture, or the path of a file of them, of which those in the
                picture are taken (`semfov.data.fixations.read_fixations`).

        Returns:
            By name: `NSS`, `AUC`, `AUC Judd`, `log likelihood` in bits above uniform, and against the density of the
            people, blurred by 3 % of the longer side, `CC`, `SIM` and `KL` in nats. Fixations outside are left out.

        Raises:
            InputError: there are no fixations beside the first ones, they are of several pictures or of another one, or
                their frame has other proportions.
            DataError: the file cannot be read.
        """
        from semfov.human.scanpath.beside import compare_density

        return compare_density(self, people)

    def plot(self, ax: Axes | None = None, **options: Any) -> Figure:
        """Draw the smallest areas that contain 10 to 90 % of the fixations, and the first three fixations.

        Args:
            ax: axes to draw in; None makes a new figure.
            options: `areas`, to draw with their shares; `scanpaths`, to draw over it; `title`, whether lines above say
                what is drawn.

        Returns:
            The figure.
        """
        from semfov.viz.gaze import plot_gaze

        return plot_gaze(self, ax=ax, **options)

    def animate(self, path: str | PathLike[str] | None = None, **options: Any) -> Path | Any:
        """Make a film of simulated viewers: a frame after each fixation, with the mean density of the next one.

        Args:
            path: GIF file to write, with an MP4 beside it where ffmpeg is installed; None returns the film for a
                notebook.
            options: `people`, the number of viewers; `duration`, the seconds for which each views the picture;
                `seconds` of a frame; `hold`, the additional seconds of the last one; and `seed`.

        Returns:
            The path, or an object that a notebook shows as an animation.

        Raises:
            InputError: an option is out of range.
            DataError: the file cannot be written.
        """
        from semfov.viz.gaze import animate_gaze

        return animate_gaze(self, path, **options)

    @checked_keywords
    def report(
        self,
        path: str | PathLike[str],
        *,
        title: str | None = None,
        people: int = 15,
        seconds: float = 3.0,
        seed: int = 0,
        areas: AreasLike | None = None,
    ) -> Path:
        """Write an HTML page with heat map, areas and scanpaths, a single file that loads nothing from elsewhere.

        Args:
            path: the file.
            title: heading of the page; None takes the name of the picture.
            people: number of viewers whose scanpaths are drawn.
            seconds: time for which each views the picture.
            seed: seed of all draws.
            areas: areas of interest to show with their shares, as for `share`.

        Returns:
            The path.

        Raises:
            InputError: the file does not end in `.html` or `.htm`, or an argument is out of range.
            DataError: the file cannot be written.
        """
        from semfov.report.gaze import gaze_page_html, gaze_part
        from semfov.report.template import write_html

        part = gaze_part(self, self.scanpaths(people, seconds=seconds, seed=seed), areas, seconds)
        heading = title or f"semfov: where people look in {self.name}"
        return write_html(Path(path), gaze_page_html(heading, [part]))

    def to_csv(self, path: str | PathLike[str], *, people: int = 15, seconds: float = 3.0, seed: int = 0) -> None:
        """Write drawn scanpaths as a table that `semfov.data.fixations.read_table` reads.

        Args:
            path: the file.
            people: number of viewers.
            seconds: time for which each views the picture.
            seed: seed of all draws.
        """
        from semfov.human.fixations.table import write_table

        write_table(path, self.scanpaths(people, seconds=seconds, seed=seed))

    def save_density(self, path: str | PathLike[str]) -> Path:
        """Write the density over the pixels: `.npy`, `.tif` with 32-bit numbers, or `.png` with the picture.

        Args:
            path: the file.

        Returns:
            The path.

        Raises:
            InputError: the file has another suffix.
            DataError: the file cannot be written.
        """
        path = Path(path)
        kind = path.suffix.lower()
        check(kind in (".npy", ".tif", ".tiff", ".png"), "path", "a file that ends in .npy, .tif or .png", path)
        content = io.BytesIO()
        if kind == ".npy":
            np.save(content, self.density.numpy(), allow_pickle=False)
        elif kind == ".png":
            self.plot().savefig(content, format="png", dpi=150, metadata={"Software": MADE_HERE})
        else:
            from PIL import Image

            Image.fromarray(self.density.float().numpy()).save(content, format="TIFF", software=MADE_HERE)
        write_bytes(path, content.getvalue())
        return path

    @checked_keywords
    def describe(self) -> str:
        """Describe the prediction in one line."""
        first = ", then ".join(f"({place['x']:z.0f}, {place['y']:z.0f})" for place in self.first_fixations())
        if self.seen is None:
            return f"people look first at {first}"
        return f"people look first at {first}, after {amount(self.seen, 'fixation')} seen by the fovea"

    def __str__(self) -> str:
        """Return the description, and the places where most fixations are expected."""
        lines = [
            f"  {number}. ({peak['x']:z.0f}, {peak['y']:z.0f}): {percent(peak['share'])} of all fixations"
            for number, peak in enumerate(self.peaks(), 1)
        ]
        if self.caution is not None:
            lines.append(f"  caution: {self.caution}")
        return "\n".join([self.describe(), *lines])

    def __repr__(self) -> str:
        return f"{type(self).__name__}: {self}"

    def _over_pixels(self, log: Tensor) -> Tensor:
        """Interpolate a log density over the cells, up to a constant, to the probability in each pixel, `(H, W)`."""
        width, height = self.size
        if self.panorama:
            columns = log.shape[1] + 2
            # Beyond an edge lie the cells of the other one.
            round_the_seam = torch.cat([log[:, -1:], log, log[:, :1]], 1)
            rows = F.interpolate(round_the_seam[None, None], (height, columns), mode="bilinear")[0, 0]
            pixels = rows @ interpolation(width, 1, columns - 1, columns, log.dtype, log.device).mT  # (H, W)
        else:
            pixels = F.interpolate(log[None, None], (height, width), mode="bilinear", align_corners=False)[0, 0]
        return (pixels - pixels.logsumexp((0, 1))).exp()

    def _log(self) -> Tensor:
        """Sum the terms to the log density over the cells, `(rows, columns)`, up to a constant."""
        return torch.stack([term[0] for term in self.terms.values()]).sum(0)


def _converted(model: FixationDensity, image: Tensor) -> FixationDensity:
    """Convert a model to the precision and the device of a picture: a copy, as predictions share the shipped model."""
    suits = image.dtype == model.read.dtype and image.device == model.read.device
    return model if suits else deepcopy(model).to(image)


def _is_blank(photograph: Tensor) -> bool:
    """Tell whether a picture `(3, h, w)` in bytes has one colour."""
    channels = photograph.flatten(1)
    # Of bytes, `aminmax` along a dimension takes thirty times as long as both.
    span = channels.amax(1).int() - channels.amin(1).int()  # (3,)
    return int(span.max()) <= _BLANK


def _fovea_of(looking: Detector | Eye, quality: Quality, panorama: bool) -> Eye:
    """Return the eye that has looked at the fixations of `seen`; raises `InputError` where a fovea cannot show it."""
    if not isinstance(looking, Eye):
        raise InputError(f"looking: expected an eye, for what it has seen, got {type(looking).__name__}")
    check(not panorama, "seen", "None for a panorama, which a fovea does not show", "fixations")
    check(quality != "best", "seen", "None for quality='best', which a fovea does not show", "fixations")
    return looking


def _foveal_features(eye: Eye, image: Tensor, fixations: Fixations, model: FixationDensity) -> FeatureMaps:
    """Compute the layers of the detector that the model reads, from what the eye has seen at fixations."""
    points = torch.from_numpy(fixations.points).to(image)
    views = eye.features(eye.open(image[None]), points, [*model.layers])
    return features_so_far(views, points, points[None])
