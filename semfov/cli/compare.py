"""Subcommand compare: what semfov finds over seconds, beside plain ways to look at slices of the same pictures."""

import sys
from collections.abc import Sequence
from functools import partial

from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.cli.agent import detector_classes, make_agent, several_classes
from semfov.cli.options import CompareOptions
from semfov.cli.outcome import table_lines
from semfov.cli.rivals import ALL_SLICES, SEMFOV, Point, Scores, Way, all_slices, best_slices, by_semfov, warm_up
from semfov.cli.sources import PictureSource, example_source, picture_sources
from semfov.cli.truth import Truth
from semfov.data.classes import amount
from semfov.data.large import open_large
from semfov.errors import check
from semfov.io.files import check_writable, write_text
from semfov.io.tables import csv_text, digits
from semfov.report.compare import comparison_page
from semfov.report.template import write_html
from semfov.viz.compare import plot_comparison
from semfov.viz.style import save_figure
from semfov.zoom.eye import WindowEye

_FILES = (".html", ".htm", ".csv", ".png", ".json")  # ends of the names of files that others would write
_COLUMNS = ("way", "passes", "seconds", "ap50", "listed", "right", "reference")
_HEADINGS = ("way", "passes", "seconds", "AP50", "listed", "right", "of")


def compare(options: CompareOptions) -> int:
    """Look at pictures in several ways, and print and write what each finds over passes and seconds.

    Args:
        options: the options of the command.

    Returns:
        The exit code, 1 if a picture was left out; where all were, nothing is written.
    """
    _check_options(options)
    truth = None if options.annotations is None else Truth(options.annotations)
    # What is wrong with the classes and the pictures is said before the agent is loaded.
    several_classes(options.target, detector_classes(options))
    sources = picture_sources(options)
    agent = make_agent(options)
    names = agent.classes[1:]
    targets = several_classes(options.target, names)
    labels = tuple(names.index(name) + 1 for name in targets or ())
    sources = sources or [example_source("sheet", names)]
    side = min(agent.eye.detector.input_size) if options.slice is None else options.slice
    ways = _ways(options, agent, labels, side)
    scores = Scores(names, labels, truth)
    skipped = _look_at_all(sources, agent.zoom.eye, ways, scores, quiet=options.quiet)
    if scores.pictures == 0:
        print("error: no picture could be looked at, so there is nothing to compare or write", file=sys.stderr)
        return 1
    points = scores.points()
    about = _about(options, scores.pictures, targets)
    sentences = [
        *conclusion(points, is_truth=truth is not None),
        f"All slices are the whole picture and squares of {side} px that overlap by {options.overlap:g}, cut as SAHI "
        "cuts them; semfov looks at them and merges what they show. Seconds are those of a picture on this machine, "
        "without reading the file.",
    ]
    _write(options, points, about, sentences)
    print("\n".join([about, *table_lines([_HEADINGS, *map(_cells, points)]), *sentences]))
    print(f"wrote {options.out}: compare.html, compare.csv, compare.png")
    return int(skipped > 0)


def _check_options(options: CompareOptions) -> None:
    """Raise an error for options that cannot be followed, before anything is loaded."""
    is_folder = options.out.suffix.lower() not in _FILES or options.out.is_dir()
    check(is_folder, "out", "a folder, for compare.html, compare.csv and compare.png", options.out)
    check_writable(options.out, folder=True)
    check(bool(options.with_), "with", "sahi, ranked, or both", "none")
    has_reference = options.annotations is not None or "sahi" in options.with_
    remedies = "--with sahi,ranked, where what all slices list stands for the truth, or --annotations FILE"
    check(has_reference, "with", remedies, "ranked alone")


def _ways(options: CompareOptions, agent: ActivePerception, labels: tuple[int, ...], side: int) -> dict[str, Way]:
    """Make semfov's way to look at a picture, and those that it is compared with; slices of a side in pixels."""
    eye = agent.zoom.eye
    ways: dict[str, Way] = {SEMFOV: partial(by_semfov, agent, labels, options.passes)}
    if "sahi" in options.with_:
        ways[ALL_SLICES] = partial(all_slices, eye, labels, side, options.overlap)
    if "ranked" in options.with_:
        ways["best slices"] = partial(best_slices, eye, labels, side, options.overlap, options.passes)
    return ways


def _look_at_all(
    sources: Sequence[PictureSource],
    eye: WindowEye,
    ways: dict[str, Way],
    scores: Scores,
    *,
    quiet: bool,
) -> int:
    """Look at all pictures in all ways; returns how many were skipped, each with its reason."""
    skipped = 0
    for source in tqdm(sources, desc="pictures", leave=False, disable=quiet or not sys.stderr.isatty()):
        try:
            _look(source, eye, ways, scores)
        except Exception as error:
            # Whatever fails at one picture, the others are looked at; `skip` raises what ends the command.
            source.skip(error, several=len(sources) > 1)
            skipped += 1
    return skipped


def _look(source: PictureSource, eye: WindowEye, ways: dict[str, Way], scores: Scores) -> None:
    """Look at a picture in all ways, and add what they find to the scores."""
    picture = open_large(source.picture())
    image = scores.image_of(source.name, picture.size, source.file)
    warm_up(eye, picture)
    findings = {name: way(picture) for name, way in ways.items()}
    scores.add(image, picture.size, findings)


def conclusion(points: Sequence[Point], *, is_truth: bool) -> list[str]:
    """Say in a sentence or two how semfov compares with all slices.

    Args:
        points: the points of all ways, with some of semfov, each way in the order of its passes.
        is_truth: whether the reference is annotated.

    Returns:
        The sentences.
    """
    ours = [point for point in points if point.way == SEMFOV]
    of_slices = [point for point in points if point.way == ALL_SLICES]
    last = ours[-1]
    result = f"After {_passes(last)} semfov has {_precision(last)} in {last.seconds:.2f} s"
    if not of_slices:
        return [f"{result}."]
    slices = of_slices[0]  # the only one: they are looked at together
    if not is_truth:
        return _agreement(last, slices)
    sentences = [
        f"{result}; all slices have {_precision(slices)} in {slices.seconds:.2f} s ({_passes(slices)}).",
    ]
    level = _level_from(ours, slices)
    if level is not None:
        sentences.append(f"It is level with them from {_passes(level)} and {level.seconds:.2f} s on.")
    return sentences


def _level_from(ours: Sequence[Point], slices: Point) -> Point | None:
    """Find the point from which on semfov is at least as good as all slices; None where they find nothing."""
    least = slices.ap50
    if not least:  # with 0 all points would be level
        return None
    level = None
    for point in reversed(ours):
        if (point.ap50 or 0) < least:
            break
        level = point
    return level


def _agreement(last: Point, slices: Point) -> list[str]:
    """Say what semfov lists after its last pass of what all slices list, which stand for the truth."""
    found = f"{last.right} of the {last.reference} objects that all slices list"
    false_alarms = amount(last.listed - last.right, "other")
    share = last.seconds / slices.seconds
    return [
        f"After {_passes(last)} semfov lists {found} and {false_alarms}, in {share:.2f} times their time.",
        "All slices miss and invent objects, too: AP50 says how well semfov agrees with them. To judge both by "
        "your own boxes, give --annotations FILE.",
    ]


def _about(options: CompareOptions, pictures: int, targets: Sequence[str] | None) -> str:
    """Say what was compared: how many pictures, which classes, and what is taken as the truth."""
    judge = "all slices are taken as the truth"
    if options.annotations is not None:
        judge = f"the truth is {options.annotations}"
    return f"{amount(pictures, 'picture')}, {', '.join(targets or ['all classes'])}; {judge}"


def _passes(point: Point) -> str:
    number = f"{point.passes:.3g}"
    return f"{number} pass" if number == "1" else f"{number} passes"


def _precision(point: Point) -> str:
    return "no AP50" if point.ap50 is None else f"an AP50 of {point.ap50:.3f}"


def _cells(point: Point) -> list[str]:
    """Write the cells of a point in the table."""
    ap50 = "" if point.ap50 is None else f"{point.ap50:.3f}"
    counts = [str(count) for count in (point.listed, point.right, point.reference)]
    return [point.way, f"{point.passes:.3g}", f"{point.seconds:.3f}", ap50, *counts]


def _write(options: CompareOptions, points: Sequence[Point], about: str, sentences: Sequence[str]) -> None:
    """Write the table, the figure and the page into a folder."""
    folder = options.out
    rows = [
        [point.way, digits(point.passes), round(point.seconds, 3), digits(point.ap50), *point.counts]
        for point in points
    ]
    write_text(folder / "compare.csv", csv_text([_COLUMNS, *rows]))
    figure = plot_comparison(points, "AP50" if options.annotations else "AP50, all slices taken as the truth")
    save_figure(figure, folder / "compare.png")
    table = [_HEADINGS, *map(_cells, points)]
    write_html(folder / "compare.html", comparison_page(about, sentences, table, figure))
