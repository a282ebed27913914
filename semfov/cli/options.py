"""Options of the subcommands: dataclasses with the names that they have in Python.

Those of a task are its settings (`semfov.settings`), with their names, types and help, and what a command adds: the
agent, the pictures and the files that are written.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from semfov.data.tone import White
from semfov.errors import InputError
from semfov.io.files import JsonObject
from semfov.io.ranges import Count, Form, Range, Seed, Whole, Workers
from semfov.kinds import Drawing, Quality
from semfov.runs.settings import Settings
from semfov.sensor.named import SensorName
from semfov.settings import (
    ExploreSettings,
    FindSettings,
    LookSettings,
    SearchSettings,
    StartSettings,
    StreamSettings,
)

ALL_DRAWINGS: tuple[Drawing, ...] = ("scanpath", "views", "belief", "animation")
"""Figures that are drawn unless others are named."""

FIGURES = (".png", ".pdf", ".svg")
"""Ends of the name of a figure of one picture."""

DEFAULT_DETECTOR = "yolox-nano"
"""Detector of commands for which none is given."""

AreasText = Annotated[
    str, Form("areas", "as NAME:LEFT,TOP,RIGHT,BOTTOM, with blanks between them, or a file .json", r".+:[\d.,-]+")
]
"""Areas of interest, as `semfov.paths.areas.boxes_of` reads them."""


@dataclass(frozen=True)
class DetectorOptions(Settings):
    """The detector.

    Args:
        detector: name or file, as for `semfov.load_detector` (none: yolox-nano).
        weights: file of the weights, for a detector that is a `.cfg` file or whose weights are not downloaded.
        classes: names of the detector's classes in the order of its scores, for a detector whose file does not hold
            them, or a text file with a name a line.
        head: output format of an ONNX file that is not recognised (docs/detectors.md).
        colour: order of the channels that an ONNX file takes, `rgb` or `bgr` (none: that of its head).
        input_size: longer side in pixels of the input of an ONNX file that takes any size.
        logits: whether an ONNX file returns scores before their sigmoid.
        per_class: let boxes suppress boxes of their own class alone, for classes of which one holds another.
        remember: write `classes`, `head`, `colour`, `input_size`, `logits` and `per_class` into a file beside the ONNX
            file, `mine.json` for `mine.onnx`, from which they are read from then on.
        device: where the detector runs, such as `cuda` or `cuda:1` (none: the processor).
    """

    detector: str | None = None
    weights: Path | None = None
    classes: tuple[str, ...] | None = None
    head: str | None = None
    colour: Literal["rgb", "bgr"] | None = None
    input_size: Annotated[int, Range(1, 65_536)] | None = None
    logits: bool = False
    per_class: bool = False
    remember: bool = False
    device: str | None = None

    def result_settings(self) -> JsonObject:
        """List the settings on which results depend: not those of folders, processes and printing."""
        from semfov.runs.config import WHERE  # with the sensors and policies, which help and refusals do without

        return {name: value for name, value in self.plain().items() if name not in (*WHERE, "quiet")}


AgentKind = Literal["recommended", "published", "raw"]


@dataclass(frozen=True)
class AgentOptions(StartSettings, DetectorOptions):
    """The agent, and where it starts.

    Args:
        agent: `recommended` (learned models, if they are shipped for the detector), `published` (the paper's:
            calibrated scores, Kaplan's rule, predictive search, Kullback-Leibler exploration) or `raw` (any detector,
            no model: scores as they are).
        detector: name or file, as for `semfov.load_detector` (none: yolox-nano, or that of `models`); with `models`,
            the new location of the detector's file.
        models: folder of models for your own detector, from `semfov fit`; it defines detector and sensor. The file of
            one model, as `python -m train.fit_search` writes it, takes the place of the shipped one.
        half: run a detector of PyTorch with numbers of 16 bits, which is faster on a GPU.
        sensor: sensor of a fovea (`semfov.sensor.SENSORS`; none: the agent's own).
        quiet: print errors and warnings alone.
    """

    agent: AgentKind = "recommended"
    models: Path | None = None
    half: bool = False
    sensor: SensorName | None = None
    quiet: bool = False

    @property
    def model_file(self) -> Path | None:
        """File of one model, where `models` names one."""
        from semfov.model_folder import is_model_file  # with the models, which help and refusals do without

        return self.models if self.models is not None and is_model_file(self.models) else None

    @property
    def models_folder(self) -> Path | None:
        """Folder of models, where `models` names one."""
        return self.models if self.model_file is None else None


@dataclass(frozen=True)
class PictureOptions(LookSettings, AgentOptions):
    """Looks at pictures, and what is written of them.

    Args:
        pictures: photographs, large pictures, folders of them, or patterns of names (none: one that comes with semfov).
        recursive: also take the photographs of the folders in a folder.
        white: values that are black and white in thermal pictures, reflectances or 12 bits: the white, `4095`, both as
            `300,3000`, or `auto` for percentiles (none: 0 and the largest value of 8 or 16 bits).
        bands: bands of a TIFF or a raster that are red, green and blue, as `4,3,2`, or one as grey (none: those that
            the file names).
        out: file of results, in a format that `--help` lists, or a folder for figures and results; `-` writes JSON
            lines to standard output, and everything else to standard error. A name that ends in `.png`, `.pdf` or
            `.svg` gets the figure of one picture.
        draw: figures to draw: `scanpath`, `views` (the foveated views), `belief` (in an exploration: the map of what is
            where), `belief_bars` (of a search) and `animation`; `none` draws nothing (not given: all but `belief_bars`,
            if `out` is a folder). Windows and a head have only `scanpath` and `animation`. If `out` is a file, they are
            written into a folder of its name.
        annotations: annotation file in COCO's format; `--out FILE.coco.json` is then a list of results with its ids of
            pictures and categories, and their average precision is printed.
        report: HTML page to write, in which to step through the looks.
        crops: folder for what the box of each object shows, as JPEG, with a folder for each class; of a search without
            one the best place.
        labels: folder for labels in the format of YOLO, a text file for each picture (`semfov.paths.Record.to_yolo`).
        looks: print every look.
        workers: number of processes that look at several pictures (each takes the memory of a detector).
        scheduler: address of a Dask scheduler whose workers do the work instead (docs/guides/cluster.md).
    """

    unused: ClassVar[tuple[str, ...]] = ("on_look",)

    pictures: tuple[str, ...] = ()
    recursive: bool = False
    white: str | None = None
    bands: str | None = None
    out: Path | None = None
    draw: tuple[Drawing, ...] | None = None
    annotations: Path | None = None
    report: Path | None = None
    crops: Path | None = None
    labels: Path | None = None
    looks: bool = False
    workers: Workers = 1
    scheduler: str | None = None

    @property
    def figure(self) -> Path | None:
        """File of the figure of one picture, where `out` names one."""
        return self.out if self.out is not None and self.out.suffix.lower() in FIGURES else None

    @property
    def results(self) -> Path | None:
        """File or folder of results, where `out` names one."""
        return self.out if self.figure is None else None

    @property
    def page(self) -> Path | None:
        """File of the page, where `report` names one or its folder."""
        if self.report is None:
            return None
        from semfov.report.template import page_path

        return page_path(self.report)


@dataclass(frozen=True)
class SearchOptions(SearchSettings, PictureOptions):
    """Search pictures for a class.

    Args:
        target: class to search for.
        embeddings: file of word vectors (text format of GloVe or word2vec); a target that is not a class of the
            detector is then spread over the classes closest in meaning.
    """

    unused: ClassVar[tuple[str, ...]] = ("on_look", "boxes")

    target: str | None = None
    embeddings: Path | None = None

    @property
    def is_for_fovea(self) -> bool:
        """Whether a setting is given that only a fovea has."""
        return self.start is not None or self.shifts is not None


@dataclass(frozen=True)
class FindOptions(FindSettings, PictureOptions):
    """Find all objects.

    Args:
        target: class to find, or several with commas (none: all classes).
    """

    target: str | None = None


@dataclass(frozen=True)
class ExploreOptions(ExploreSettings, PictureOptions):
    """Explore pictures."""

    unused: ClassVar[tuple[str, ...]] = ("on_look", "policy")


@dataclass(frozen=True)
class LiveOptions(StreamSettings, AgentOptions):
    """Look at a video, a camera or a network stream.

    Args:
        source: video file, folder of frames in the order of their names, or address of a stream.
        camera: number of a camera.
        target: class to search for (none: explore).
        find: class of which all objects are to be found, or several with commas, in place of a target.
        frames: number of frames to look at (none: all of them; a camera until Ctrl-C).
        white: values that are black and white, as for `semfov search`, such as of a thermal camera of 16 bits.
        out: video to write, `.mp4` or `.avi`, or a folder for it, with gaze and belief, or windows and objects, drawn
            into each frame.
        tracks: file to write of the objects of each frame, with numbers that stay, `.txt` in MOTChallenge's format.
    """

    unused: ClassVar[tuple[str, ...]] = ("color",)

    source: str | None = None
    camera: Whole | None = None
    target: str | None = None
    find: str | None = None
    frames: Count | None = None
    white: str | None = None
    out: Path | None = None
    tracks: Path | None = None


@dataclass(frozen=True)
class GazeOptions(DetectorOptions):
    """Predict where people look.

    Args:
        pictures: photographs, folders of them, or patterns of names (none: one that comes with semfov).
        recursive: also take the photographs of the folders in a folder.
        detector: name or file of the detector whose features are read, as for `semfov.load_detector` (none:
            yolox-nano).
        model: file of a model for your own detector, from `semfov fit` (none: the one that is shipped).
        quality: `quick`, one pass of the detector; or `best`, six, over windows and a mirror image, too.
        panorama: each picture is a panorama of 360°, whose left and right edge meet.
        people: number of viewers whose scanpaths are drawn.
        seconds: time in seconds for which each views a picture.
        white: values that are black and white, as for `semfov search`.
        bands: bands of a TIFF or a raster that are shown, as for `semfov search`.
        seed: seed of all draws.
        out: file of scanpaths, `.csv`; of the density of one picture, `.npy`, `.tif` or `.png`; or a folder for
            scanpaths and a heat map of each picture.
        report: HTML page to write, in which to step through the fixations.
        areas: areas of interest in pixels of each picture, of which the share of the fixations is said and drawn, as
            `logo:10,20,200,80` (left, top, right and bottom edge), several with blanks between them; or a JSON file,
            `{"logo": [10, 20, 200, 80]}`, or one of each picture, `{"before.png": {"logo": …}, "after.png": …}`.
        compare: compare two pictures: both maps on one scale, what differs, and the shares of areas beside each other.
        quiet: print errors and warnings alone.
    """

    pictures: tuple[str, ...] = ()
    recursive: bool = False
    model: Path | None = None
    quality: Quality = "quick"
    panorama: bool = False
    people: Annotated[int, Range(1, 1000)] = 15
    seconds: Annotated[float, Range(0.1, 60)] = 3.0
    white: str | None = None
    bands: str | None = None
    seed: Seed = 0
    out: Path | None = None
    report: Path | None = None
    areas: AreasText | None = None
    compare: bool = False
    quiet: bool = False


@dataclass(frozen=True)
class AppOptions(AgentOptions):
    """A page on which to try the agent out, served to the browsers of this machine.

    Args:
        host: address that the page is served on. Another one than that of this machine lets others use it, who need
            the token in the address that is printed.
        port: its port (none: the first free one from 7860 on).
    """

    unused: ClassVar[tuple[str, ...]] = ("seed", "start")

    host: str = "127.0.0.1"
    port: Annotated[int, Range(1, 65_535)] | None = None


@dataclass(frozen=True)
class McpOptions(AgentOptions):
    """Tools for language models, over the pictures below a folder.

    Args:
        folder: the folder; files elsewhere are refused, also by links.
    """

    unused: ClassVar[tuple[str, ...]] = ("seed", "start")

    folder: Path = Path()


Rival = Literal["sahi", "ranked"]


@dataclass(frozen=True)
class CompareOptions(AgentOptions):
    """What semfov finds over seconds, beside plain ways to look at slices of the same pictures.

    Args:
        pictures: photographs, large pictures, folders of them, or patterns of names (none: one that comes with semfov).
        recursive: also take the photographs of the folders in a folder.
        with_: beside what: `sahi`, the whole picture and all its slices, as SAHI cuts them; `ranked`, these slices in
            the order of the scores that the whole picture has in them.
        target: class to find, or several with commas (none: all classes).
        annotations: annotation file in COCO's format (none: what all slices list stands for the truth).
        passes: most passes of the detector for a picture, for semfov and `ranked`.
        slice: side of a slice in pixels (none: that of the detector's input).
        overlap: share of the side of a slice that the next one repeats.
        white: values that are black and white, as for `semfov search`.
        bands: bands of a TIFF or a raster that are shown, as for `semfov search`.
        out: folder for the page, the table and the figure.
    """

    unused: ClassVar[tuple[str, ...]] = ("seed", "start", "sensor")

    pictures: tuple[str, ...] = ()
    recursive: bool = False
    with_: tuple[Rival, ...] = ("sahi",)
    target: str | None = None
    annotations: Path | None = None
    passes: Annotated[int, Range(1, 1000)] = 24
    slice: Annotated[int, Range(16, 16_384)] | None = None
    overlap: Annotated[float, Range(0, 0.9)] = 0.2
    white: str | None = None
    bands: str | None = None
    out: Path = Path("semfov-compare")


@dataclass(frozen=True)
class DemoOptions(Settings):
    """A page of what semfov does, on the photographs that come with it.

    Args:
        out: HTML page to write.
        quiet: print errors and warnings alone.
    """

    out: Path = Path("semfov-demo.html")
    quiet: bool = False


@dataclass(frozen=True)
class CheckOptions(Settings):
    """Check files of fixations.

    Args:
        files: tables, ASC files of EyeLink, or JSON files of fixations.
        size: width and height of the frame, `1920,1080`, where the file has none.
        picture: name of the picture, where the file has none; or a picture or folder of pictures that the file names,
            whose sizes are compared with the frames, and are the frames where the file has none.
        subject: name of the person, where the file has none.
        columns: names of a table's columns by ours, where they differ, `x=FPOGX,y=FPOGY`.
        rules_alone: leave out the comparison of fixations with where people look in the pictures, a pass of the
            detector for each of at most 40 pictures.
        quiet: print errors alone; the exit code tells whether anything is suspicious.
    """

    files: tuple[str, ...] = ()
    size: str | None = None
    picture: str | None = None
    subject: str | None = None
    columns: str | None = None
    rules_alone: bool = False
    quiet: bool = False


@dataclass(frozen=True)
class DetectorsOptions(DetectorOptions):
    """Detectors that can be named.

    Args:
        name: name or file of a detector whose classes are listed, or a folder of models.
        try_: photograph in which to compare what the bare detector shows with what semfov lists.
    """

    unused: ClassVar[tuple[str, ...]] = ("detector",)

    name: Path | None = None
    try_: Path | None = None


def white_of(text: str | None) -> White | None:
    """Read the values that are black and white."""
    if text is None:
        return None
    if text == "auto":
        return "auto"
    first, separator, second = text.partition(",")
    try:
        return (float(first), float(second)) if separator else float(first)
    except ValueError:
        raise InputError(f"white: expected 4095, 300,3000 or auto, got {text!r}") from None
