"""Jobs of the commands search, find and explore: what a process does with a picture."""

import io
import sys
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import fields
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

import torch
from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.agents.kinds import KINDS_OF_LOOK
from semfov.agents.picture import PictureLike
from semfov.belief.grid import Grid
from semfov.cli.agent import detector_classes, detector_of, make_agent, several_classes
from semfov.cli.options import ALL_DRAWINGS, ExploreOptions, FindOptions, PictureOptions, SearchOptions
from semfov.cli.outcome import PictureOutcome
from semfov.cli.results import STDOUT, kind_of
from semfov.cli.sources import PictureSource, example_source, picture_sources
from semfov.cli.truth import Truth
from semfov.data import WordVectors, spread
from semfov.data.classes import known_class, several_known
from semfov.data.examples import example_with
from semfov.data.large import picture_size
from semfov.errors import InputError, SemfovError, check
from semfov.head.scenes import World
from semfov.io.files import check_apart, check_writable, sha256
from semfov.io.manifest import FILE as MANIFEST
from semfov.io.pretrained import Pretrained
from semfov.io.ranges import CheckedSettings
from semfov.kinds import Drawing
from semfov.paths import Record
from semfov.settings import ExploreSettings, FindSettings, SearchSettings

_Options_co = TypeVar("_Options_co", bound=PictureOptions, covariant=True)


class PictureJob(ABC, Generic[_Options_co]):
    """Looks at pictures as the options say; any process can make it from the options.

    Attributes:
        task: settings that the options give to the agent, as its keywords.
        every: whether all objects are wanted, which begins with the whole picture.
        drawings: figures that can be drawn of the looks of a fovea.
        sources: the pictures.
        title: what is done, in words.
        target: class that is searched for, or the first of those to find; None for all.
        targets: the classes that results are about; None for all.
        weights: probability that each class is meant by the target of a search; empty for other tasks.
    """

    task: ClassVar[type[CheckedSettings]]
    every: ClassVar[bool] = False
    drawings: ClassVar[tuple[Drawing, ...]] = ALL_DRAWINGS

    def __init__(self, options: _Options_co, agent: ActivePerception | None = None) -> None:
        self.options = options
        self.title = ""
        self.target: str | None = None
        self.targets: Sequence[str] | None = None
        self.weights: dict[str, float] = {}
        self.sources = picture_sources(options)
        self.several = len(self.sources) > 1
        # The cheap checks come first: a mistake is told before files are read and the detector is loaded.
        self._check_names()
        self.truth = None if options.annotations is None else Truth(options.annotations)
        self._check_before_loading()

        if agent is None:
            # What is wrong with the target is reported before the agent is loaded, where its classes are known by then.
            self.aim(detector_classes(options))
            agent = make_agent(options)
        self.agent = agent
        classes = self.agent.classes[1:]  # without background
        self.aim(classes)
        if self.truth is not None:
            self.truth.categories(self.targets or classes)
        if not self.sources:
            name = "sheet" if self.every else example_with(self.target, classes)
            self.sources = [example_source(name, classes, self.target)]

    def _check_before_loading(self) -> None:
        """Raise an error for options that cannot be followed, before anything is loaded."""
        options = self.options
        if self.truth is not None:
            # A picture that the annotations lack is reported now, and not after hours.
            self.truth.check_pictures([source.name for source in self.sources])
        if self.every:
            first = "none for find, which begins with the whole picture"
            check(options.start is None, "start", first, repr(options.start))
        _check_outputs(options)
        check_apart(options.figure, [source.file for source in self.sources])
        expected = f"a folder for the figures of {len(self.sources):,} pictures"
        check(options.figure is None or not self.several, "out", expected, options.figure)

    def _check_names(self) -> None:
        """Raise `InputError` where files that are named as their pictures would have the same name."""
        counts = Counter(str(source.place.with_suffix("")) for source in self.sources)
        repeated = [place for place, times in counts.items() if times > 1]
        for name, folder in {"crops": self.options.crops, "labels": self.options.labels}.items():
            is_free = folder is None or not repeated
            expected = f"pictures of different names with --{name}, whose files have their names"
            check(is_free, name, expected, ", ".join(repeated[:3]))

    def aim(self, classes: Sequence[str] | None) -> None:
        """Take the target from the options; before the names of the classes are known it is not checked.

        Args:
            classes: the detector's classes; None if they are known only after it is loaded.
        """
        self.title = "exploration"

    def depends_on(self) -> dict[str, object]:
        """List what outcomes depend on besides pictures and code, such as settings and fitted models."""
        agent = self.agent
        manifest = self.options.model_file
        if self.options.models_folder is not None:
            manifest = self.options.models_folder / MANIFEST
        # Agents that Python makes are told apart by the settings of their parts.
        parts = [(place, type(part).__qualname__, _plain_attributes(part)) for place, part in agent.named_modules()]
        return {
            "options": self.options.result_settings(),
            "eye": agent.eye.settings(),
            "classes": agent.classes,
            "models": [module for module in agent.modules() if isinstance(module, Pretrained)],
            "parts": parts,
            "weights": self.weights,
            "folder": None if manifest is None else sha256(manifest),
            "annotations": None if self.truth is None else self.truth.digest,
        }

    @abstractmethod
    def look(self, picture: PictureLike, settings: dict[str, Any], source: PictureSource) -> Record:
        """Look at a picture.

        Args:
            picture: the opened picture.
            settings: the settings of the task, as keywords of the agent.
            source: where the picture is from.

        Returns:
            The record.
        """

    def outcome(self, number: int) -> PictureOutcome | SemfovError:
        """Look at a picture, and make its text, row and figures.

        Args:
            number: number of the picture.

        Returns:
            The outcome. An error is returned, not raised, where other pictures can still be looked at.
        """
        source = self.sources[number]
        try:
            with torch.inference_mode():
                return self._outcome_of(source)
        except Exception as error:
            # Whatever fails at one picture, the others are looked at; `fault` raises what ends the command.
            return source.fault(error, several=self.several)

    def _outcome_of(self, source: PictureSource) -> PictureOutcome:
        """Look at a picture, and make its text, row and figures; raises whatever is wrong with it."""
        began = time.perf_counter()
        picture = source.opened(self.options.how)
        if self.truth is not None:
            # Its size is checked before it is looked at: boxes in another frame could not be judged.
            image = self.truth.image_id(source.name)
            self.truth.orientation(image, source.name, picture_size(source.picture()), source.file)
        settings = {setting.name: getattr(self.options, setting.name) for setting in fields(self.task)}
        if isinstance(picture, World):  # a scene is looked at by a head, whatever it was opened as
            settings["how"] = "auto"
        settings["on_look"] = self._progress(source.name)
        record = self.look(picture, settings, source)
        seconds = time.perf_counter() - began
        return PictureOutcome.of(record, picture, source, self.options, seconds, self.truth)

    def _progress(self, name: str) -> Callable[[Record], object] | None:
        """Make the bar of passes of one picture on a terminal, as a function that is called after each look."""
        # Several pictures have one bar together.
        if self.several or self.options.quiet or not sys.stderr.isatty():
            return None
        bar = tqdm(desc=Path(name).name, unit="pass", total=self.options.passes, leave=False, dynamic_ncols=True)
        return lambda record: bar.update(record.passes - bar.n)

    def check_drawings(self) -> None:
        """Raise `InputError` where a picture is looked at in a way that has no figure of a kind that is wanted."""
        wanted = self.options.draw
        if not wanted:
            return
        for source in self.sources:
            try:
                kind = self.agent.kind_of_look(source.picture(), self.options.how, every=self.every)
            except Exception:
                continue  # it is reported when the picture is looked at
            possible = [drawing for drawing in KINDS_OF_LOOK[kind].kind.drawings if drawing in self.drawings]
            impossible = ", ".join(drawing for drawing in wanted if drawing not in possible)
            expected = f"{' or '.join(possible)} for {source.name}, which is looked at by {kind!r}"
            check(not impossible, "draw", expected, impossible)


class SearchJob(PictureJob[SearchOptions]):
    """Searches pictures for a class."""

    task = SearchSettings
    drawings = (*ALL_DRAWINGS, "belief_bars")

    def aim(self, classes: Sequence[str] | None) -> None:
        """Find the classes that the target may mean, each with a weight."""
        options = self.options
        if not options.target:
            name = options.models_folder or detector_of(options)
            raise InputError(f"target: expected a class, --target cup, got none; `semfov detectors {name}` lists them")
        if classes is not None and not self.weights:
            self.weights = meant_classes(options, classes)
            self.target = next(iter(self.weights))
            self.targets = [self.target]
            self.title = f"search for “{self.target}”"

    def look(self, picture: PictureLike, settings: dict[str, Any], source: PictureSource) -> Record:
        """Search a picture, for several classes with a fovea; elsewhere for the most likely one of them."""
        several = len(self.weights) > 1
        foveal = several or self.options.is_for_fovea
        if self.agent.kind_of_look(picture, settings["how"], foveal=foveal) == "fovea":
            return self._search_with_fovea(picture, settings, source)
        if several:
            note = f"large pictures and scenes are searched only for the most likely class: {self.target}"
            print(note, file=sys.stderr)
        return self.agent.search(picture, next(iter(self.weights)), **settings)

    def _search_with_fovea(self, picture: PictureLike, settings: dict[str, Any], source: PictureSource) -> Record:
        """Search a picture for the classes with their weights; the first look at an example is off the target."""
        if settings["start"] is None:
            settings = {**settings, "start": self._start_off_target(source)}
        if len(self.weights) > 1:
            return self.agent.search(picture, self.weights, **{**settings, "how": "fovea"})
        return self.agent.search(picture, next(iter(self.weights)), **settings)

    def _start_off_target(self, source: PictureSource) -> int | None:
        """Draw a first cell off the target of an example; None for other pictures, whose target is not known."""
        scene = source.scene
        if scene is None or scene.boxes is None:
            return None
        height, width = scene.image.shape[-2:]
        grid = Grid(self.agent.columns, self.agent.rows, (width, height))
        covered = grid.footprint(scene.boxes).any(0)  # (X·Y,), by any box
        free_cells = (~covered).nonzero()[:, 0]
        if not len(free_cells):
            return None
        generator = torch.Generator().manual_seed(self.options.seed)
        return int(free_cells[torch.randint(len(free_cells), (1,), generator=generator)])


class FindJob(PictureJob[FindOptions]):
    """Finds all objects in pictures."""

    task = FindSettings
    every = True

    def aim(self, classes: Sequence[str] | None) -> None:
        """Take the classes to find; None for all."""
        self.targets = several_classes(self.options.target, classes)
        self.target = None if self.targets is None else self.targets[0]
        self.title = "all objects" if not self.targets else f"all objects: {', '.join(self.targets)}"

    def look(self, picture: PictureLike, settings: dict[str, Any], source: PictureSource) -> Record:
        """Find all objects in a picture."""
        return self.agent.find_all(picture, self.targets, **settings)


class ExploreJob(PictureJob[ExploreOptions]):
    """Explores pictures."""

    task = ExploreSettings

    def look(self, picture: PictureLike, settings: dict[str, Any], source: PictureSource) -> Record:
        """Explore a picture."""
        return self.agent.explore(picture, **settings)


def make_again(kind: type[PictureJob[PictureOptions]], options: PictureOptions) -> PictureJob[PictureOptions]:
    """Make a job in a process that works for another one.

    Args:
        kind: the class of the job.
        options: its options.

    Returns:
        The job.
    """
    with redirect_stdout(io.StringIO()):  # the process that was called has said it
        return kind(options)


def _plain_attributes(part: torch.nn.Module) -> dict[str, object]:
    """List the numbers and words among the attributes of a part."""
    return {name: value for name, value in vars(part).items() if type(value) in (bool, int, float, str)}


def _check_outputs(options: PictureOptions) -> None:
    """Raise an error for outputs that cannot be written or do not go together, before anything is loaded."""
    out = options.results
    kind = None if out is None else kind_of(out)
    for file in (options.figure, options.page):
        check_writable(file)
    for folder in (options.crops, options.labels):
        check_writable(folder, folder=True)
    has_file_of_results = out not in (None, STDOUT)
    if has_file_of_results:
        check_writable(out, folder=kind is None)
    if options.annotations is not None:
        check(kind == ".coco.json", "annotations", "--out FILE.coco.json beside it", out)
    if options.draw:
        check(has_file_of_results, "draw", "--out FOLDER beside --draw", "none")


def meant_classes(options: SearchOptions, classes: Sequence[str]) -> dict[str, float]:
    """Find the classes that the target of a search may mean.

    Args:
        options: the options, with the target and the word vectors.
        classes: the detector's classes.

    Returns:
        The weight of each class that may be meant, the most likely first.

    Raises:
        InputError: the target is no class, and there are no word vectors by which it means some.
    """
    target = options.target or ""
    try:
        return {known_class(target, classes, "target"): 1.0}
    except InputError as error:
        if options.embeddings is None:
            return _any_of_classes(options, classes, error)
    vectors = WordVectors.read(options.embeddings, [target, *classes])
    weights = spread(target, classes, vectors)
    print(f"“{target}” may mean: {', '.join(f'{name} {weight:.2f}' for name, weight in weights.items())}")
    if vectors.missing:
        print(f"  words without a vector in {options.embeddings}: {', '.join(vectors.missing)}")
    return weights


def _any_of_classes(options: SearchOptions, classes: Sequence[str], error: InputError) -> dict[str, float]:
    """Read a target that is no class as several classes for a fovea; else raise the error with what it can be."""
    names = several_known(options.target or "", classes)
    is_foveal = options.how == "fovea" or options.is_for_fovea
    if names and is_foveal:
        return dict.fromkeys(names, 1.0)
    remedy = "a description needs --embeddings, a file of word vectors"
    if names:
        remedy = "--how fovea searches for any of them, and `semfov find` finds all"
    elif "did you mean" in str(error):
        raise error
    raise InputError(f"{error}; {remedy}") from None
