"""Subcommand gaze: predicts where people look in pictures, and writes scanpaths, heat maps and a page."""

import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from semfov.agents.picture import OpenedPicture
from semfov.cli.agent import check_onnx_options, detector_options, remember
from semfov.cli.options import GazeOptions
from semfov.cli.results import held_outputs, tell_written, unfinished
from semfov.cli.sources import example_source, picture_sources
from semfov.data.examples import EXAMPLES
from semfov.data.fixations import Fixations, write_table
from semfov.detection.load import check_detector, load_detector
from semfov.errors import check
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.io.files import check_writable, plain_name
from semfov.paths.gaze import GazePrediction
from semfov.report.gaze import gaze_page_html, gaze_part
from semfov.report.template import page_path, write_html
from semfov.runs.config import WHERE
from semfov.runs.results import SceneResults

_DENSITIES = (".npy", ".tif", ".tiff", ".png")

_Outcome = dict[str, Any]
"""What is written of a picture, as JSON values: text, drawn viewers, part of a page, and file of the density."""


def predict_gaze(options: GazeOptions) -> int:
    """Predict where people look in all pictures; returns the exit code, 1 if a picture was left out."""
    job = _GazeJob(options)
    with held_outputs(options):
        return _look_at_pictures(job)


class _GazeJob:
    """Predicts where people look in pictures; what an interrupted command has predicted is read again."""

    def __init__(self, options: GazeOptions) -> None:
        self.options, self.sources, out = options, picture_sources(options), options.out
        kind = "" if out is None or out.is_dir() else out.suffix.lower()
        check(kind in ("", ".csv", *_DENSITIES), "out", "a folder, or a file .csv, .npy, .tif or .png", out)
        several = len(self.sources) > 1
        check(kind not in _DENSITIES or not several, "out", "a .csv file or a folder for several pictures", out)
        if options.report is not None:
            check_writable(page_path(options.report))
        check_detector(options.detector)
        check_onnx_options(options, options.detector)
        loaded = detector_options(options)
        own = None if options.model is None else FixationDensity.from_pretrained(options.model)
        self.detector = load_detector(options.detector, **loaded)
        remember(options, options.detector)
        self.model = FixationDensity.for_detector(self.detector) if own is None else own
        if not self.sources:
            self.sources = [example_source(EXAMPLES[0])]
            print(f"no picture was given: looking at {self.sources[0].name}, which comes with semfov")
        self.kind, self.several = kind, several
        self.table = None if out is None or kind in _DENSITIES else out if kind else out / "scanpaths.csv"
        self.outcomes: dict[int, _Outcome] = {}
        self.finished: SceneResults | None = None
        if several and self.table is not None:
            settings = {name: value for name, value in options.plain().items() if name not in (*WHERE, "quiet")}
            depends_on = {"options": settings, "detector": self.detector.settings(), "model": self.model}
            self.finished = unfinished(self.table, depends_on, self.sources)
            for number, each in self.finished.items(len(self.sources)):
                (outcome,) = each["records"]
                if "density" not in outcome or Path(outcome["density"]).exists():  # one that is gone is written again
                    self.outcomes[number] = outcome

    def look(self, number: int) -> None:
        """Predict where people look in a picture, and write the density."""
        source, out = self.sources[number], self.options.out
        image = OpenedPicture.of(source.opened("auto")).image(torch.zeros(1))[0]
        file = None if source.file is None else str(source.file)
        prediction = GazePrediction.of(self.detector, image, model=self.model, source=file)
        paths = prediction.scanpaths(self.options.people, seconds=self.options.seconds, seed=self.options.seed)
        places = "; ".join(
            f"{number}. ({peak['x']:.0f}, {peak['y']:.0f}) {100 * peak['share']:.0f} %"
            for number, peak in enumerate(prediction.peaks(), 1)
        )
        terms = ", ".join(f"{term} {bits:.2f}" for term, bits in prediction.parts.items())
        mean = sum(map(len, paths)) / len(paths)
        text = (
            f"{source.name}: {prediction.describe()}\n  places: {places}\n  added by each term, in bits: {terms}\n"
            f"  {len(paths)} viewers drawn, {mean:.1f} fixations each"
        )
        width, height = prediction.size
        if self.options.model is None and width <= height:
            text += "\n  the model was fitted to pictures that are wider than high, and may be wrong here"
        viewers = [[each.subject, each.points.tolist(), np.asarray(each.durations).tolist()] for each in paths]
        part = None if self.options.report is None else gaze_part(prediction, paths)
        outcome: _Outcome = {"text": text, "size": prediction.size, "viewers": viewers, "part": part}
        if out is not None and self.kind != ".csv":
            name = f"{plain_name(Path(prediction.name).stem)}.png"
            name = f"{number:03d}-{name}" if self.several else name
            outcome["density"] = str(prediction.save_density(out if self.kind else out / name))
        self.outcomes[number] = outcome

    def keep(self, number: int) -> None:
        """Keep what was predicted of a picture for the same command, until all pictures are looked at."""
        if self.finished is not None:
            self.finished.save(number, [self.outcomes[number]], {})

    def write(self, *, complete: bool) -> None:
        """Write scanpaths and page of the pictures so far, and list all files."""
        outcomes = [self.outcomes[number] for number in sorted(self.outcomes)]
        written = [Path(each["density"]) for each in outcomes if "density" in each]
        # As in the folder, or where two pictures would then have one name, as they were named.
        names = [Path(source.name).name for source in self.sources]
        count = Counter(name.lower() for name in names)
        named = zip(names, self.sources, strict=True)
        names = [name if count[name.lower()] == 1 else source.name for name, source in named]
        if self.table is not None and outcomes:
            paths = [
                Fixations(names[number], subject, np.array(points), tuple(each["size"]), np.array(durations))
                for number, each in sorted(self.outcomes.items())
                for subject, points, durations in each["viewers"]
            ]
            write_table(self.table, paths)
            written.insert(0, self.table)
        if self.options.report is not None and outcomes:
            parts = [each["part"] for each in outcomes]
            for number, part in zip(sorted(self.outcomes), parts, strict=True):
                part["picture"]["name"] = names[number]
            written.append(write_html(self.options.report, gaze_page_html("semfov: where people look", parts)))
        tell_written(written, self.finished, None if complete else f"{len(outcomes)} of {len(self.sources)}")


def _look_at_pictures(job: _GazeJob) -> int:
    """Predict where people look; no other command writes the same files meanwhile."""
    options = job.options
    sources, outcomes = job.sources, job.outcomes
    if outcomes:
        print(f"continuing: {len(outcomes)} of {len(sources)} pictures were looked at before")
    left, complete = [number for number in range(len(sources)) if number not in outcomes], False
    hidden = not job.several or options.quiet or not sys.stderr.isatty()
    try:
        for number in tqdm(left, unit="picture", leave=False, disable=hidden):
            try:
                job.look(number)
            except Exception as error:
                fault = sources[number].fault(error, several=job.several)
                if not job.several:
                    raise
                tqdm.write(f"skipped {sources[number].name}: {fault}", file=sys.stderr)
            else:
                job.keep(number)
                tqdm.write(outcomes[number]["text"], file=sys.stdout)
        complete = True
    finally:  # a command that is stopped has written the pictures so far
        job.write(complete=complete)
    return 1 if len(outcomes) < len(sources) else 0
