"""Subcommand gaze: predicts where people look in pictures, and writes scanpaths, heat maps and a page."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from semfov.agents.picture import open_picture
from semfov.cli.agent import check_device
from semfov.cli.options import GazeOptions
from semfov.cli.sources import PictureSource, picture_sources
from semfov.cli.text import plain_name
from semfov.data.fixations import write_table
from semfov.data.sources import embedded_picture
from semfov.detection.load import check_detector, load_detector
from semfov.errors import SemfovError, check
from semfov.io.files import check_writable
from semfov.paths.gaze import GazePrediction
from semfov.report.gaze import DrawnGaze, write_gaze_page
from semfov.report.page import page_path

_DENSITIES = (".npy", ".tif", ".tiff", ".png")


def predict_gaze(options: GazeOptions) -> int:
    """Predict where people look in all pictures; returns the exit code, 1 if a picture was left out."""
    sources = picture_sources(options)
    kind = None if options.out is None or options.out.is_dir() else options.out.suffix.lower()
    check(kind in (None, "", ".csv", *_DENSITIES), "out", "a folder, or a file .csv, .npy, .tif or .png", options.out)
    check(
        kind not in _DENSITIES or len(sources) < 2, "out", "a .csv file or a folder for several pictures", options.out
    )
    if options.report is not None:
        check_writable(page_path(options.report))
    check_detector(options.detector)
    given = {"weights": options.weights, "device": check_device(options.device)}
    loaded: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    detector = load_detector(options.detector, **loaded)
    if not sources:
        print("no picture was given: looking at an embedded scene")
        scene = embedded_picture(detector.classes, None, options.seed)
        sources = [PictureSource("embedded scene", scene=scene)]
    drawn: list[DrawnGaze] = []
    skipped = 0
    try:
        for source in tqdm(
            sources, unit="picture", leave=False, disable=len(sources) == 1 or options.quiet or not sys.stderr.isatty()
        ):
            try:
                image = open_picture(source.opened("auto")).image(torch.zeros(1))[0]
                prediction = GazePrediction.of(
                    detector, image, source=None if source.file is None else str(source.file)
                )
            except SemfovError as error:
                if len(sources) == 1:
                    raise
                skipped += 1
                tqdm.write(f"skipped {source.name}: {error}", file=sys.stderr)
                continue
            paths = prediction.scanpaths(options.people, seconds=options.seconds, seed=options.seed)
            drawn.append(DrawnGaze(prediction, tuple(paths)))
            places = "; ".join(
                f"{number}. ({peak['x']:.0f}, {peak['y']:.0f}) {peak['share']:.0%}"
                for number, peak in enumerate(prediction.peaks(), 1)
            )
            terms = ", ".join(f"{term} {bits:.2f}" for term, bits in prediction.parts.items())
            mean = sum(map(len, paths)) / len(paths)
            tqdm.write(
                f"{source.name}: {prediction.describe()}\n  places: {places}\n  added by each term, in bits: {terms}\n"
                f"  {len(paths)} viewers drawn, {mean:.1f} fixations each",
                file=sys.stdout,
            )
    finally:  # a command that is stopped has written the pictures so far
        if drawn:
            written = _write(options, kind, drawn)
            if written:
                print("written:", *(f"  {path}" for path in written), sep="\n")
    return 1 if skipped else 0


def _write(options: GazeOptions, kind: str | None, drawn: list[DrawnGaze]) -> list[Path]:
    """Write what the options name, and return the files."""
    written: list[Path] = []
    out = options.out
    paths = [path for each in drawn for path in each.scanpaths]
    if out is not None and kind == ".csv":
        write_table(out, paths)
        written.append(out)
    elif out is not None and kind in _DENSITIES:
        written.append(drawn[0].prediction.save_density(out))
    elif out is not None:
        write_table(out / "scanpaths.csv", paths)
        written.append(out / "scanpaths.csv")
        for number, each in enumerate(drawn):
            name = plain_name(Path(each.prediction.name).stem)
            start = f"{number:03d}-" if len(drawn) > 1 else ""
            written.append(each.prediction.save_density(out / f"{start}{name}.png"))
    if options.report is not None:
        title = "semfov: where people look"
        written.append(write_gaze_page(options.report, title, drawn))
    return written
