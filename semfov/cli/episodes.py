"""Searches and explorations of pictures: one after another, with results, figures and a page."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from semfov.agent import ActivePerception, How, PictureLike
from semfov.belief.grid import Grid
from semfov.cli.options import ALL_DRAWINGS, Drawing, PictureOptions
from semfov.cli.results import ResultsFile, kind_of
from semfov.cli.text import looks_text, outcome_text, plain_name
from semfov.data.large import picture_size
from semfov.data.sources import Picture, embedded_picture, is_video, picture_files
from semfov.errors import InputError, SemfovError, check
from semfov.head import Flat, Panorama
from semfov.head.world import World
from semfov.paths import GazeRecord, Scanpath, ZoomPath
from semfov.report import Pool, episode_data, write_page, zoom_data
from semfov.viz.animation import film_of
from semfov.viz.belief import plot_belief_bars, plot_belief_strip
from semfov.viz.scanpath import plot_foveated_strip, plot_scanpath
from semfov.viz.semantic import plot_semantic_map
from semfov.viz.style import save_figure

LookAtPicture = Callable[[PictureLike, dict[str, Any], "PictureSource"], GazeRecord]
"""Looks at a picture, with the arguments that all subcommands share, and returns the record."""


@dataclass(frozen=True)
class PictureSource:
    """A picture to look at.

    Attributes:
        name: its name in texts.
        file: its file; None for an embedded scene.
        scene: the embedded scene.
    """

    name: str
    file: Path | None = None
    scene: Picture | None = None

    @property
    def boxes(self) -> Tensor | None:
        """True boxes of the target in an embedded scene."""
        return None if self.scene is None else self.scene.boxes

    def opened(self, how: How) -> PictureLike:
        """The picture, or for a head the scene that it is a picture of."""
        picture = str(self.file) if self.scene is None else self.scene.image
        if how != "head":
            return picture
        width, height = picture_size(picture)
        return Panorama(picture) if width == 2 * height else Flat(picture)


def picture_sources(options: PictureOptions) -> list[PictureSource]:
    """The pictures that the options name, those of folders in the order of their names.

    Args:
        options: the options.

    Returns:
        The pictures; none stands for an embedded scene.

    Raises:
        InputError: one is a video or an address.
        DataError: one does not exist, or a folder has no pictures.
    """
    found: list[PictureSource] = []
    for name in options.pictures:
        path = Path(name)
        check("://" not in name, "picture", "a file on this machine (`semfov live` takes streams)", repr(name))
        check(not is_video(path), "picture", "photographs; `semfov live` takes videos", name)
        found += [PictureSource(str(each), each) for each in picture_files(path)]
    return found


@dataclass
class EpisodeOutputs:
    """What is written of the pictures.

    Attributes:
        options: the options.
        title: title of the page.
        searched: whether the pictures were searched for a target.
        several: whether there are several pictures, each of which gets a folder for its figures.
        settings: settings of the eye (`Eye.settings`).
    """

    options: PictureOptions
    title: str
    searched: bool
    several: bool
    settings: Mapping[str, Any]
    results: ResultsFile | None = None
    folder: Path | None = None
    drawings: tuple[Drawing, ...] = ()
    written: list[Path] = field(default_factory=list)
    pool: Pool = field(default_factory=Pool)
    episodes: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Check the file of results, and choose the figures."""
        options = self.options
        kind = None if options.out is None else kind_of(options.out)
        self.folder = options.out
        if options.out is not None:
            file = options.out if kind is not None else options.out / "results.json"
            self.results = ResultsFile(file, kind or ".json", searched=self.searched)
            self.folder = options.out.with_name(options.out.name.partition(".")[0]) if kind is not None else options.out
        usual = ALL_DRAWINGS if options.out is not None and kind is None else ()
        self.drawings = usual if options.draw is None else options.draw

    def add(self, number: int, source: PictureSource, record: GazeRecord, seconds: float) -> None:
        """Write what is wanted of a picture."""
        if self.results is not None:
            self.results.add(source.name, record, seconds, source.file)
        views: list[Tensor] = []
        if isinstance(record, Scanpath) and (self.options.report or {"views", "animation"} & set(self.drawings)):
            views = record.views()
        if self.folder is not None and self.drawings:
            name = plain_name(Path(source.name).name)
            folder = self.folder / f"{number:03d}-{name}" if self.several else self.folder
            self.written += draw_episode(folder, record, source.boxes, views, self.drawings)
        if self.options.report is not None:
            name = Path(source.name).name
            if isinstance(record, Scanpath):
                data = episode_data(record, record.image, views, self.pool, name=name, boxes=source.boxes)
                self.episodes.append(data)
            else:
                # A scene has no more pixels than the record keeps.
                whole = source.file if source.scene is None else source.scene.image
                picture = whole if isinstance(record, ZoomPath) else None
                data = zoom_data(record, picture, self.pool, name=name, settings=self.settings)
                self.episodes.append(data)

    def finish(self) -> None:
        """Write the results and the page of all pictures so far, and list what was written."""
        if self.results is not None:
            self.results.write()
            self.written.insert(0, self.results.path)
        if self.options.report is not None and self.episodes:
            page = write_page(self.options.report, f"semfov: {self.title}", self.episodes, self.pool)
            self.written.append(page)
        if self.written:
            print("written:", *(f"  {path}" for path in self.written), sep="\n")


def look_at_pictures(
    options: PictureOptions, agent: ActivePerception, look: LookAtPicture, title: str, target: str | None = None
) -> int:
    """Look at all pictures, print what was found, and write what is wanted.

    A picture that cannot be read is reported and left out, unless it is the only one.

    Args:
        options: the options.
        agent: the agent.
        look: looks at one picture.
        title: title of the page.
        target: class that was searched for, which an embedded scene must hold.

    Returns:
        The exit code: 1 if a picture was left out.

    Raises:
        SemfovError: nothing could be looked at.
    """
    found = picture_sources(options)
    if not found:
        scene = embedded_picture(agent.classes[1:], target, options.seed)
        print("no picture was given: looking at an embedded scene")
        found = [PictureSource("embedded scene", scene=scene)]
    several = len(found) > 1
    outputs = EpisodeOutputs(options, title, title.startswith("search"), several, agent.eye.settings())
    skipped, done, tally = 0, 0, dict[str, int]()
    try:
        for number, source in _shown(found):
            began = time.perf_counter()
            try:
                with torch.inference_mode():
                    picture = source.opened(options.how)
                    record = look(picture, _shared(options, picture, source, several), source)
                    seconds = time.perf_counter() - began
                    outputs.add(number, source, record, seconds)
            except SemfovError as error:
                # A wrong argument is not the fault of a picture.
                if not several or (isinstance(error, InputError) and not done):
                    raise
                skipped += 1
                tqdm.write(f"skipped {source.name}: {error}", file=sys.stderr)
                if outputs.results is not None:
                    outputs.results.skip(source.name, str(error))
                continue
            done += 1
            outcome = "looked at" if record.decision is None else record.decision.outcome
            tally[outcome] = tally.get(outcome, 0) + 1
            tqdm.write(outcome_text(record, source.name, seconds), file=sys.stdout)
            if options.looks:
                tqdm.write(looks_text(record), file=sys.stdout)
    finally:
        if done or skipped:
            outputs.finish()
    if several:
        counts = ", ".join(f"{count} {name}" for name, count in tally.items())
        print(f"{len(found)} pictures: {counts}{f'; {skipped} skipped' if skipped else ''}")
    return 1 if skipped else 0


def _shown(found: Sequence[PictureSource]) -> Iterator[tuple[int, PictureSource]]:
    """The pictures with their numbers; a bar moves with them if there are several and somebody looks."""
    hidden = True if len(found) < 2 else None
    yield from enumerate(tqdm(found, desc="pictures", unit="picture", dynamic_ncols=True, disable=hidden))


def _shared(options: PictureOptions, picture: PictureLike, source: PictureSource, several: bool) -> dict[str, Any]:
    """Arguments that all subcommands share, and a bar for the passes in a single picture."""
    how: How = "auto" if isinstance(picture, World) else options.how
    given: dict[str, Any] = {"how": how, "passes": options.passes, "seconds": options.seconds}
    given |= {"shifts": options.shifts, "duration": options.duration}
    if not several and sys.stderr.isatty():
        bar = tqdm(desc=Path(source.name).name, unit="pass", total=options.passes, leave=False, dynamic_ncols=True)
        given["on_look"] = lambda record: bar.update(record.passes - bar.n)
    return given


def start_beside(agent: ActivePerception, source: PictureSource, seed: int) -> int | None:
    """A random first cell off the target of an embedded scene; None for other pictures.

    Args:
        agent: the agent.
        source: the picture.
        seed: seed of the draw.

    Returns:
        The number of the cell.
    """
    if source.scene is None or source.boxes is None:
        return None
    grid = Grid(agent.columns, agent.rows, (source.scene.image.shape[-1], source.scene.image.shape[-2]))
    free = (~grid.footprint(source.boxes).any(0)).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(seed)
    return int(free[torch.randint(len(free), (1,), generator=generator)]) if len(free) else None


def draw_episode(
    folder: Path, record: GazeRecord, boxes: Tensor | None, views: list[Tensor], wanted: Sequence[Drawing]
) -> list[Path]:
    """Write the wanted figures and the animation of an episode.

    Args:
        folder: folder to write to.
        record: the record.
        boxes: true boxes of the target, if they are known.
        views: foveated views of a scanpath.
        wanted: names of the figures; those that a record of this kind has not are left out.

    Returns:
        The paths of the files.
    """
    figures: dict[str, Callable[[], Any]] = {"scanpath": record.plot}
    if isinstance(record, Scanpath):
        figures["scanpath"] = lambda: plot_scanpath(record, boxes=boxes)
        figures["views"] = lambda: plot_foveated_strip(record, views)
        if record.target is not None:
            figures["belief"] = lambda: plot_belief_strip(record)
            figures["belief_bars"] = lambda: plot_belief_bars(record)
        else:
            figures["map"] = lambda: plot_semantic_map(record)
    names = ["map" if name == "belief" and "map" in figures else name for name in wanted]
    written = [save_figure(figures[name](), folder / f"{name}.png") for name in names if name in figures]
    if "animation" in wanted:
        path = folder / "animation.gif"
        if isinstance(record, Scanpath):
            written += film_of(record, views=views, boxes=boxes).save(path)
        else:
            written.append(record.animate(path))
    return written
