"""Subcommand gaze: predicts where people look in pictures, and writes scanpaths, heat maps and a page."""

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NotRequired, Self, TypedDict, cast

import numpy as np
import torch
from tqdm import tqdm

from semfov.agents.picture import OpenedPicture
from semfov.cli.agent import check_onnx_options, detector_options, remember
from semfov.cli.options import DEFAULT_DETECTOR, GazeOptions
from semfov.cli.results import FinishedWork, held_outputs, tell_continuing, tell_written, unfinished
from semfov.cli.sources import example_source, picture_sources
from semfov.data.examples import EXAMPLES
from semfov.data.fixations import Fixations
from semfov.detection import Detector
from semfov.detection.load import check_detector, load_detector
from semfov.errors import check
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.io.files import check_apart, check_writable, plain_name, write_text
from semfov.io.tables import csv_text, digits
from semfov.paths.areas import boxes_of, percent
from semfov.paths.drafts import Drafts
from semfov.paths.gaze import GazePrediction
from semfov.report.drafts import drafts_section
from semfov.report.episode import Data
from semfov.report.gaze import ViewedArea, gaze_page_html, gaze_part, viewed_areas
from semfov.report.template import page_path, write_html
from semfov.viz.style import save_figure

_DENSITIES = (".npy", ".tif", ".tiff", ".png")
_PICTURES = "pictures.csv"  # name of the table of pictures, after that of the scanpaths
_COMPARED = Path("semfov-compare.html")  # page of a comparison for which no file is named


class _Outcome(TypedDict):
    """What is written of a picture, as JSON values.

    `text` is printed; `size` is `(width, height)`; `viewers` are the drawn ones, each a name, points and durations;
    `facts` stand in the table of pictures; `part` is that of the page, None without one; `density` is its file.
    """

    text: str
    size: tuple[int, int]
    viewers: list[tuple[str, list[list[float]], list[float]]]
    facts: dict[str, object]
    part: Data | None
    density: NotRequired[str]


def predict_gaze(options: GazeOptions) -> int:
    """Predict where people look in all pictures.

    Args:
        options: the options of the command.

    Returns:
        The exit code, 1 if a picture was left out.
    """
    job = _GazeJob(options)
    with held_outputs(options):  # no other command writes the same files meanwhile
        return _look_at_pictures(job)


@dataclass(frozen=True)
class _Outputs:
    """Files that the command writes; None for those that it does not.

    Attributes:
        table: scanpaths of all pictures.
        pictures: table of the pictures.
        density: density of the only picture.
        folder: folder of the densities.
        figure: figure of a comparison.
    """

    table: Path | None = None
    pictures: Path | None = None
    density: Path | None = None
    folder: Path | None = None
    figure: Path | None = None

    @classmethod
    def of(cls, out: Path | None, *, several: bool, compared: bool) -> Self:
        """Find the files by the name that `out` gives: that of a table, of a figure or density, or of a folder."""
        if out is None:
            return cls()
        kind = "" if out.is_dir() else out.suffix.lower()
        if kind == "":
            return cls(out / "scanpaths.csv", out / _PICTURES, folder=out, figure=out / "compare.png")
        if kind == ".csv":
            return cls(out, out.with_name(f"{out.stem}-{_PICTURES}"))
        if compared:
            check(kind == ".png", "out", "a folder, or a file .csv or .png", out)
            return cls(figure=out)
        check(kind in _DENSITIES, "out", "a folder, or a file .csv, .npy, .tif or .png", out)
        check(not several, "out", "a .csv file or a folder for several pictures", out)
        return cls(density=out)


class _GazeJob:
    """Predicts where people look in pictures; what an interrupted command has predicted is read again.

    Attributes:
        outputs: the files that are written beside the page.
        outcomes: what is known of the pictures so far, by number.
        report: the page that is written; None for none.
        areas: areas of interest; None for none.
        predictions: the predictions that are compared, by number.
        finished: the outcomes that the same command takes up after an interruption.
    """

    def __init__(self, options: GazeOptions) -> None:
        self.options = options
        self.sources = picture_sources(options)
        self.several = len(self.sources) > 1
        # The cheap checks come first: a mistake is told before the detector is loaded.
        remedy = "without it the page of several pictures has the shares side by side"
        are_drafts = not options.compare or len(self.sources) == 2
        check(are_drafts, "compare", "two pictures", f"{len(self.sources)}; {remedy}")
        self.outputs = _Outputs.of(options.out, several=self.several, compared=options.compare)
        check_apart(options.out, [source.file for source in self.sources])
        self.areas = None if options.areas is None else boxes_of(options.areas)
        self.report = _page_of(options)
        if self.report is not None:
            check_writable(page_path(self.report))
        self.detector, self.model = _load(options)
        if not self.sources:
            self.sources = [example_source(EXAMPLES[0])]
            self.sources[0].tell_example()
        self.predictions: dict[int, GazePrediction] = {}
        self.outcomes: dict[int, _Outcome] = {}
        self.finished = FinishedWork()
        # A comparison needs both predictions whole, and what is kept of a picture is less.
        if self.several and not options.compare and self.outputs.table is not None:
            self.finished = self._take_up(self.outputs.table)

    def _take_up(self, table: Path) -> FinishedWork:
        """Read what an interrupted command has predicted of the same pictures."""
        depends_on = {
            "options": self.options.result_settings(),
            "detector": self.detector.settings(),
            "model": self.model,
            "areas": self.areas,
        }
        finished = unfinished(table, depends_on, self.sources)
        for number, values in finished.outcomes():
            outcome = cast(_Outcome, values)
            if "density" not in outcome or Path(outcome["density"]).exists():  # one that is gone is written again
                self.outcomes[number] = outcome
        return finished

    def look(self, number: int) -> None:
        """Predict where people look in a picture, and write the density."""
        options = self.options
        source = self.sources[number]
        image, size = OpenedPicture.of(source.picture()).viewed(torch.zeros(1), panorama=options.panorama)
        file = None if source.file is None else str(source.file)
        stated_model = None if options.model is None else self.model
        prediction = GazePrediction.of(
            self.detector, image, model=stated_model, source=file, size=size, quality=options.quality,
            panorama=options.panorama,
        )  # fmt: skip
        paths = prediction.scanpaths(options.people, seconds=options.seconds, seed=options.seed)
        areas = viewed_areas(prediction, self.areas, options.seconds)
        part = None if self.report is None else gaze_part(prediction, paths, self.areas, options.seconds)
        outcome: _Outcome = {
            "text": _text(source.name, prediction, paths, areas),
            "size": prediction.size,
            "viewers": [_viewer(path) for path in paths],
            "facts": _facts(prediction, areas),
            "part": part,
        }
        density = self._density_path(number)
        if density is not None:
            outcome["density"] = str(self._save_density(density, prediction))
        if options.compare:
            self.predictions[number] = prediction
        self.outcomes[number] = outcome

    def _density_path(self, number: int) -> Path | None:
        """Name the file of a density: the one that is given, or one in the folder, numbered if there are several."""
        folder = self.outputs.folder
        if folder is None:
            return self.outputs.density
        name = f"{plain_name(self.sources[number].place.stem)}.png"
        return folder / (f"{number:03d}-{name}" if self.several else name)

    def _save_density(self, path: Path, prediction: GazePrediction) -> Path:
        """Write the density of a picture, a heat map with the areas."""
        if path.suffix.lower() == ".png":
            return save_figure(prediction.plot(areas=self.areas), path)
        return prediction.save_density(path)

    def write(self, *, complete: bool) -> None:
        """Write scanpaths, table of pictures and page of the pictures so far, and list all files."""
        outcomes = dict(sorted(self.outcomes.items()))
        drafts = Drafts(*self.predictions.values()) if len(self.predictions) == 2 else None
        written = [
            *self._write_tables(outcomes),
            *_densities(outcomes),
            *self._write_comparison(drafts),
            *self._write_page(outcomes, drafts),
        ]
        tell_written(written)
        self.finished.end("" if complete else f"{len(outcomes)} of {len(self.sources)}")

    def _write_comparison(self, drafts: Drafts | None) -> list[Path]:
        """Say how two drafts differ, if there are two, and draw it if a figure is written."""
        if drafts is None:
            return []
        print(drafts.describe(self.areas))
        if self.outputs.figure is None:
            return []
        return [save_figure(drafts.plot(areas=self.areas), self.outputs.figure)]

    def _write_tables(self, outcomes: Mapping[int, _Outcome]) -> list[Path]:
        """Write the table of scanpaths, and beside it that of the pictures."""
        from semfov.human.fixations.table import write_table

        table = self.outputs.table
        pictures = self.outputs.pictures
        if table is None or pictures is None or not outcomes:
            return []
        names = self._names()
        paths: list[Fixations] = []
        for number, outcome in outcomes.items():
            paths += _fixations(names[number], outcome)
        write_table(table, paths)
        facts = {names[number]: outcome["facts"] for number, outcome in outcomes.items()}
        write_text(pictures, _table_of_pictures(facts))
        return [table, pictures]

    def _write_page(self, outcomes: Mapping[int, _Outcome], drafts: Drafts | None) -> list[Path]:
        """Write the page of all pictures, if it is wanted; it begins with the comparison of two drafts."""
        # Where one of two drafts cannot be read, an earlier comparison is not replaced by half of one.
        lacks_draft = self.options.compare and drafts is None
        if self.report is None or not outcomes or lacks_draft:
            return []
        names = self._names()
        parts = []
        for number, outcome in outcomes.items():
            part = outcome["part"]
            assert part is not None  # there is one of each picture where a page is written
            part["picture"]["name"] = names[number]
            parts.append(part)
        before = "" if drafts is None else drafts_section(drafts, self.areas)
        return [write_html(self.report, gaze_page_html("semfov: where people look", parts, before))]

    def _names(self) -> list[str]:
        """Name the pictures as in their folder, or as they were named where two would have the same."""
        counts = Counter(Path(source.name).name.lower() for source in self.sources)
        names = []
        for source in self.sources:
            name = Path(source.name).name
            is_only_one = counts[name.lower()] == 1
            names.append(name if is_only_one else source.name)
        return names


def _densities(outcomes: Mapping[int, _Outcome]) -> list[Path]:
    """List the files of the densities that were written."""
    return [Path(outcome["density"]) for outcome in outcomes.values() if "density" in outcome]


def _page_of(options: GazeOptions) -> Path | None:
    """Name the page that is written; a comparison is always written somewhere."""
    if options.compare and options.report is None and options.out is None:
        return _COMPARED
    return options.report


def _load(options: GazeOptions) -> tuple[Detector, FixationDensity]:
    """Load the detector, and the model of fixations: the stated one, or the one that is shipped for the detector."""
    name = options.detector or DEFAULT_DETECTOR
    check_detector(name)
    check_onnx_options(options, name)
    loading = detector_options(options)
    # A model that cannot be read is reported before the detector is loaded.
    stated_model = None if options.model is None else FixationDensity.from_pretrained(options.model)
    detector = load_detector(name, **loading)
    remember(options, name)
    return detector, FixationDensity.for_detector(detector) if stated_model is None else stated_model


def _text(name: str, prediction: GazePrediction, paths: Sequence[Fixations], areas: Mapping[str, ViewedArea]) -> str:
    """Say what is known of a prediction and the viewers that are drawn from it."""
    lines = [f"{name}: {prediction.describe()}"]
    for area_name, area in areas.items():
        lines.append(f"  {area_name}: {percent(area.share)} of all fixations, {area.visits}")
    places = []
    for number, peak in enumerate(prediction.peaks(), 1):
        places.append(f"{number}. ({peak['x']:z.0f}, {peak['y']:z.0f}) {100 * peak['share']:.0f} %")
    lines.append(f"  most fixations: {'; '.join(places)}")
    mean = sum(map(len, paths)) / len(paths)
    lines.append(f"  {len(paths)} viewers drawn, {mean:.1f} fixations each")
    if prediction.caution is not None:
        lines.append(f"  caution: {prediction.caution}")
    return "\n".join(lines)


def _facts(prediction: GazePrediction, areas: Mapping[str, ViewedArea]) -> dict[str, object]:
    """List what the table of pictures says of a prediction."""
    width, height = prediction.size
    facts: dict[str, object] = {
        "width": width,
        "height": height,
        "unlike": prediction.unlike,
        "unlikeness": digits(prediction.unlikeness),
        "caution": prediction.caution,
    }
    for number, place in enumerate(prediction.first_fixations(), 1):
        facts[f"x {number}"] = place["x"]
        facts[f"y {number}"] = place["y"]
        facts[f"viewers {number}"] = place["share"]
    for name, area in areas.items():
        facts[f"share of {name}"] = digits(area.share)
        facts[f"viewers of {name}"] = area.visits.viewers
        facts[f"seconds to {name}"] = area.visits.seconds
    return facts


def _table_of_pictures(facts: Mapping[str, Mapping[str, object]]) -> str:
    """Write the table of pictures as CSV: a line for each, with its first fixations and shares of areas."""
    columns = [*next(iter(facts.values()))]
    rows: list[Sequence[object]] = [["picture", *columns]]
    for name, facts_of_picture in facts.items():
        cells = [facts_of_picture[column] for column in columns]
        rows.append([name, *cells])
    return csv_text(rows)


def _viewer(path: Fixations) -> tuple[str, list[list[float]], list[float]]:
    """List name, points and durations of a drawn viewer, from which `_fixations` makes the scanpath again."""
    return path.subject, path.points.tolist(), np.asarray(path.durations).tolist()


def _fixations(name: str, outcome: _Outcome) -> list[Fixations]:
    """Make the scanpaths of the viewers that were drawn for a picture."""
    width, height = outcome["size"]
    return [
        Fixations(name, subject, np.array(points), (width, height), np.array(durations))
        for subject, points, durations in outcome["viewers"]
    ]


def _look_at_pictures(job: _GazeJob) -> int:
    """Predict where people look in the pictures that are left; a command that is stopped has written those so far."""
    options = job.options
    sources = job.sources
    tell_continuing(len(job.outcomes), len(sources))
    numbers = [number for number in range(len(sources)) if number not in job.outcomes]
    hidden = not job.several or options.quiet or not sys.stderr.isatty()
    complete = False
    try:
        for number in tqdm(numbers, unit="picture", leave=False, disable=hidden):
            _look_at_picture(job, number)
        complete = True
    finally:
        job.write(complete=complete)
    return int(len(job.outcomes) < len(sources))


def _look_at_picture(job: _GazeJob, number: int) -> None:
    """Predict where people look in a picture; one of several that cannot be looked at is skipped."""
    try:
        job.look(number)
    except Exception as error:
        # Whatever fails at one picture, the others are looked at; `skip` raises what ends the command.
        job.sources[number].skip(error, several=job.several)
    else:
        job.finished.keep(number, job.outcomes[number])
        tqdm.write(job.outcomes[number]["text"], file=sys.stdout)
