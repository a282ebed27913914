"""The agent: it looks at any picture, searches it for a class, finds all objects in it or explores it."""

from collections.abc import Callable, Sequence
from os import PathLike, fspath
from typing import Any, Self

from torch import Tensor

from semfov.agents.fovea import FoveaAgent
from semfov.agents.head import HeadAgent
from semfov.agents.kinds import KINDS_OF_LOOK, KindOfLook
from semfov.agents.picture import OpenedPicture, PictureLike, check_order
from semfov.agents.windows import ZoomAgent, knows_photographs, window_eye
from semfov.attribute_words import AGENT, missing
from semfov.belief.grid import check_cells
from semfov.belief.observers import Observer, SemanticMap, SemanticSearch
from semfov.belief.observers.any_of import TargetLike
from semfov.belief.prior import PriorLike
from semfov.belief.verification import Verification
from semfov.data.classes import class_numbers
from semfov.data.inputs import Color
from semfov.data.tone import White
from semfov.data.windowed import ChosenBands
from semfov.detection.load import DetectorLike
from semfov.detection.scores import HALVES
from semfov.errors import InputError, check, check_options, checked_keywords
from semfov.eye import Eye
from semfov.gaze.policies import Policy
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.io.compatibility import check_fitted
from semfov.io.state import MovableModule
from semfov.kinds import KindName, Quality
from semfov.live import LivePerception
from semfov.model_folder import is_model_file, open_folder
from semfov.observation.foveal import FovealObservationModel
from semfov.paths import GazePrediction, Record
from semfov.paths.viewed import ScanpathLike
from semfov.presets import (
    model_file_arguments,
    option_names,
    published_arguments,
    raw_arguments,
    recommended_arguments,
)
from semfov.settings import (
    ExploreSettings,
    FindSettings,
    How,
    LookSettings,
    OnLook,
    SearchSettings,
    Start,
    StreamSettings,
    documented_by,
)
from semfov.strategy import Strategy, classes_named
from semfov.zoom import GlimpseEvidence

_Targets = str | int | Sequence[str | int] | None  # a class by name or index, several of them, or None for all classes


class ActivePerception(MovableModule):
    """An agent that looks at any picture to search for a target, to find all objects, or to map what is where.

    By default (`how="auto"`) the agent looks at a flat picture through windows, first at the whole picture (`windows`),
    and at a scene such as a `semfov.Panorama` with eye and head (`head`). `how="fovea"` moves a fovea over the cells of
    a photograph, as in the paper. If the agent has no evidence for photographs, `auto` does so for pictures less than
    four times as long as the detector's input. `record.how` has the kind that was used.

    Args:
        eye: sensor and detector.
        search: observer and policy for search.
        explore: observer and policy for exploration; during a search this observer keeps the map of all classes.
        verification: probabilities after closer looks (`semfov.belief.Verification`); None: no closer looks.
        windows: evidence for windows (`semfov.zoom.GlimpseEvidence`); None: slices, by their scores in the overview.
        grid: `(columns, rows)` of the belief, 1 to 200 each.
        photographs: whether to look at photographs, too, through windows; always if the evidence was fitted to them.

    Raises:
        InputError: `grid` is out of range, or a model was fitted for another detector, sensor or grid.

    Example::

        agent = ActivePerception.recommended()
        agent.search("kitchen.jpg", "cup").decision
        agent.find_all("harbour.jpg", "boat", passes=16).objects
        agent.search(semfov.Panorama("street.jpg"), "bicycle").plot()
    """

    @checked_keywords
    def __init__(
        self,
        eye: Eye,
        search: tuple[Observer, Policy],
        explore: tuple[Observer, Policy],
        *,
        verification: Verification | None = None,
        windows: GlimpseEvidence | None = None,
        grid: tuple[int, int] = (10, 10),
        photographs: bool = False,
    ) -> None:
        super().__init__()
        self.eye = eye
        self.verification = verification
        self.windows = windows
        self.photographs = photographs
        self.searching = Strategy(*search)
        self.exploring = Strategy(*explore)
        check_cells(grid)
        self.columns, self.rows = grid
        models = [model for model in self.modules() if isinstance(model, FovealObservationModel | Verification)]
        check_fitted(models, eye.settings(), grid)

    @classmethod
    def recommended(
        cls,
        name: str = "yolox-nano",
        *,
        grid: tuple[int, int] = (10, 10),
        **options: Any,
    ) -> Self:
        """Make the agent for everyday use: the method of the paper, with observation models trained for its tasks.

        It sees through the `gradual` fovea, or looks at windows.

        Args:
            name: a detector with shipped models: `yolox-nano`, `yolov3-tiny`, `nanodet-plus-m-1.5x` (with `weights=`).
            grid: `(columns, rows)` of the belief; the models are fitted on 10 x 10 cells, and hold for 5 to 20 a side.
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: no models are shipped for this detector, or for this grid.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(recommended_arguments, name, grid, **options)

    @classmethod
    def from_pretrained(cls, name: str | PathLike[str] = "yolox-nano", **options: Any) -> Self:
        """Load the agent from a folder that `semfov.fit_detector` wrote, or the recommended agent for a detector.

        From the file of one model, as `python -m train.fit_search` writes it, this makes the recommended agent with
        that model instead of the shipped one.

        Args:
            name: the folder, the file of a model, or the name of a detector as for `recommended`.
            options: options of `recommended`; for a folder, of `semfov.model_folder.ModelFolder.load_detector`; for a
                file, `detector=`, the detector that its model was fitted to, if its name does not suffice.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: there is no such folder, and no models are shipped for a detector of this name.
            DataError: a file is missing or damaged, or the detector is not the one that the models were fitted to.
        """
        if is_model_file(name):
            return cls._of(model_file_arguments, name, **options)
        folder = open_folder(name)
        return cls.recommended(fspath(name), **options) if folder is None else cls._of(folder.arguments, **options)

    @classmethod
    def published(
        cls,
        name: str | PathLike[str] = "yolox-nano",
        *,
        sensor: str | None = None,
        search: str = "predictive",
        calibrated: bool = True,
        **options: Any,
    ) -> Self:
        """Make the agent of Luzio, Bernardino and Moreno (2024), with a small detector for which models are shipped.

        It has 10 x 10 cells with a uniform prior of 0.5. Kaplan's rule updates every cell that a box overlaps, with
        scores calibrated by Dirichlets of maximum likelihood. Exploration maximises the Kullback-Leibler divergence.
        The paper states neither the widths of its two foveas nor a score threshold: ours are 100 and 50 pixels of 640,
        and 0.02. For the wide fovea there are also models for `threshold=` 0.1, 0.25 and 0.5. The paper's detector,
        YOLOv3, is larger. If `name` is a folder of models, detector, sensor, grid and observation model come from it.

        Args:
            name: a detector that models are shipped for, `yolox-nano` or `yolov3-tiny`, or a folder of models.
            sensor: `published`, the wide fovea, or `published-narrow`; None is the wide one, or that of the folder.
            search: `predictive` or `non-predictive`.
            calibrated: whether scores are calibrated by the observation model before fusion ("Modified Kaplan").
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: no models are shipped for this detector or this sensor, or the folder has no observation model.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(published_arguments, name, sensor, search, calibrated, **options)

    @classmethod
    def raw(cls, name: DetectorLike = "yolox-nano", *, sensor: str = "published", **options: Any) -> Self:
        """Make an agent for any detector, without fitted models: raw scores as likelihoods, and random exploration.

        It looks at every flat picture through windows, photographs included.

        Args:
            name: name, path or model of the detector, as for `semfov.load_detector`.
            sensor: name of the sensor (`semfov.sensor.SENSORS`).
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: the detector or the sensor is unknown.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(raw_arguments, name, sensor, **options)

    @classmethod
    def _of(cls, make: Callable[..., dict[str, Any]], /, *arguments: object, **options: Any) -> Self:
        """Make an agent of the parts that a function gives from the options of a constructor, ready for use."""
        names = ["name"] if make in (recommended_arguments, published_arguments, raw_arguments) else []
        check_options(options, [*names, *option_names(make)], "the agent or of semfov.load_detector")
        return cls(**make(*arguments, **options)).eval().requires_grad_(False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or convert the agent; half precision is for the detector alone, as beliefs and decisions need more."""
        self.eye.detector.check_conversion(fn)

        def move_precisely(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return tensor.to(moved.device) if moved.dtype in HALVES else moved

        super()._apply(move_precisely, recurse)
        self.eye.detector._apply(fn, recurse)
        return self

    def __getattr__(self, name: str) -> Any:
        """Find a part of the module; other libraries' words for what an agent does are refused with its own."""
        if name in AGENT:
            raise missing("an agent", name, AGENT)
        try:
            return super().__getattr__(name)
        except AttributeError:
            raise missing("an agent", name, AGENT, dir(type(self))) from None

    def forward(self, *arguments: object, **options: object) -> None:
        """Raise an error that lists the agent's methods, because the agent itself cannot be called.

        Args:
            *arguments: any.
            **options: any.

        Raises:
            InputError: always.
        """
        raise InputError("an agent is not called itself: it has search, find_all, explore, gaze and live")

    def __repr__(self) -> str:
        """Write the detector, the sensor and the parts that were fitted in one line."""
        fitted = [name for name in ("windows", "verification") if getattr(self, name) is not None]
        detector = f"{self.eye.detector.settings()['name']}, {len(self.classes) - 1} classes"
        parts = f"{detector}, {type(self.eye.sensor).__name__}, cells={(self.columns, self.rows)}, fitted={fitted}"
        return f"{type(self).__name__}({parts})"

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first."""
        return ("background", *self.eye.detector.classes)

    @property
    def fovea(self) -> FoveaAgent:
        """The part of the agent that moves a gaze over photographs."""
        return FoveaAgent(self.eye, self.searching, self.exploring, self.verification, (self.columns, self.rows))

    @property
    def zoom(self) -> ZoomAgent:
        """The part of the agent that looks at windows."""
        eye = window_eye(self.eye.detector, self.windows)
        return ZoomAgent(eye, self.windows, self.photographs).train(self.training)

    @property
    def head(self) -> HeadAgent:
        """The part of the agent that turns a head in a scene.

        Raises:
            InputError: the agent has no observation models for searches and maps.
        """
        search = self.searching.observer
        explore = self.exploring.observer
        if not (isinstance(search, SemanticSearch) and isinstance(explore, SemanticMap)):
            got = f"{type(search).__name__} and {type(explore).__name__}"
            remedy = "use ActivePerception.recommended, or fit them to your detector (semfov fit)"
            raise InputError(f"how: expected a semantic search and a semantic map for a head, got {got}; {remedy}")
        return HeadAgent(self.eye, search.model, explore.model)

    def kind_of_look(
        self, picture: PictureLike | OpenedPicture, how: How = "auto", *, every: bool = False, foveal: bool = False
    ) -> KindName:
        """Choose how the agent looks at a picture.

        Args:
            picture: as for `search`, or one that is opened.
            how: `auto` chooses by the picture; another kind is returned, if it suits the picture.
            every: whether all objects are wanted.
            foveal: whether other settings need a fovea: several classes, a first cell, gaze shifts or true boxes.

        Returns:
            `fovea`, `windows` or `head`.

        Raises:
            InputError: the kind is unknown, or does not suit a scene.
        """
        photographs = not foveal and (self.photographs or knows_photographs(self.windows))
        return OpenedPicture.of(picture).kind(how, self.eye.detector.input_size, every=every, photographs=photographs)

    @checked_keywords
    @documented_by(SearchSettings)
    def search(  # noqa: D417 (`documented_by`)
        self,
        picture: PictureLike,
        target: TargetLike,
        *,
        how: How = "auto",
        passes: int | None = None,
        shifts: int | None = None,
        seconds: float | None = None,
        duration: float | None = None,
        on_look: OnLook | None = None,
        start: Start = None,
        seed: int = 0,
        boxes: Tensor | Sequence[Sequence[float]] | None = None,
        confirm: float | None = None,
        stop_below: float | None = None,
        closer: int | None = None,
        prior: PriorLike = None,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> Record:
        """Search a picture for a target class, and decide whether it is there (`record.decision`).

        If a place seems to hold the target, the recommended agent takes a closer look: it enlarges a window around the
        place to the detector's input (`semfov.decision.Verifier`). The search ends with `found` when the target is
        probable enough at such a place. Otherwise it ends when no further look is worth a pass, or when a limit is
        reached.

        Without closer looks the search ends with `found` when the picture holds the target with enough probability, and
        a fixated cell is nearly as probable as the most probable one (`semfov.decision.decide`).

        An agent without calibrated thresholds, such as `published`, never gives up. It finds the target when a
        detection on the fixated cell has the target as its best class, with a score of at least `confirm`.

        With `boxes`, as in the paper, the search makes no decision: it ends with the gaze on a cell that a box meets.

        Args:
            picture: a picture of any common kind and size (`semfov.as_image`): a path, a Pillow image, an array or a
                tensor; a `semfov.data.windowed.LargePicture`; or a scene: a `semfov.Panorama`, a
                `semfov.Flat`, or a camera that turns (`semfov.head.PanTiltCamera`).
            target: class by name or index 1..K. With `how="fovea"` also several: a list of classes, any of which will
                do, or a mapping from each to the probability that it is meant (`AnyOf`, `semfov.data.spread`). The
                target of the record is then the most probable class.
            color: order of the channels of arrays and tensors, `rgb`, or `bgr` as OpenCV reads them.
            white: the value that is white where 0 is black, `(black, white)`, or `auto` for percentiles (`read_image`).
            bands: numbers of a TIFF's red, green and blue band, from 1, or of one grey band; None: as the file says.

        Returns:
            The record, with its decision: a `Scanpath`, a `ZoomPath` or a `HeadPath`.

        Raises:
            InputError: the class is unknown (near names are suggested), or an argument does not fit the kind of look.
            DataError: the file of the picture cannot be read.
        """
        check_order(picture, target, self.classes[1:])
        settings = SearchSettings(
            how=how,
            passes=passes,
            shifts=shifts,
            seconds=seconds,
            duration=duration,
            on_look=on_look,
            start=start,
            seed=seed,
            confirm=confirm,
            stop_below=stop_below,
            closer=closer,
            prior=prior,
            boxes=boxes,
        )
        any_of_several = len(classes_named(target)) > 1
        of_fovea = any(value is not None for value in (start, boxes, shifts))
        if any_of_several and how == "auto":
            expected = "one class; find_all takes several, and how='fovea' searches for any of them"
            check(of_fovea, "target", expected, target)
        opened = OpenedPicture.of(picture, color, white, bands)
        return self._look(opened, settings, foveal=of_fovea or any_of_several).search(opened, target, settings)

    @checked_keywords
    @documented_by(FindSettings)
    def find_all(  # noqa: D417 (`documented_by`)
        self,
        picture: PictureLike,
        target: _Targets = None,
        *,
        how: How = "auto",
        passes: int | None = None,
        shifts: int | None = None,
        seconds: float | None = None,
        duration: float | None = None,
        on_look: OnLook | None = None,
        min_gain: float | None = None,
        score_threshold: float | None = None,
        batch: int = 1,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> Record:
        """Find all objects of a class, of several or of all classes (`record.objects`, `record.expected`).

        The first look is the whole picture. Each further look is the window, of any magnification, with the largest
        expected number of new objects. In a photograph, a few looks after the first cover everything.

        Args:
            picture: as for `search`.
            target: class by name or index 1..K, several in a list, or None for all classes.
            color: order of the channels of arrays and tensors, `rgb` or `bgr`.
            white: the values that are black and white, as for `search`.
            bands: the bands that are shown, as for `search`.

        Returns:
            The record with its objects: a `ZoomPath`, a `Scanpath` or a `HeadPath`.

        Raises:
            InputError: a class is unknown (nearest names are suggested), or an argument does not fit the kind of look.
            DataError: the file of the picture cannot be read.
        """
        check_order(picture, target, self.classes[1:])
        targets = class_numbers(target, self.classes[1:], "target")
        settings = FindSettings(
            how=how,
            passes=passes,
            shifts=shifts,
            seconds=seconds,
            duration=duration,
            on_look=on_look,
            min_gain=min_gain,
            score_threshold=score_threshold,
            batch=batch,
        )
        opened = OpenedPicture.of(picture, color, white, bands)
        return self._look(opened, settings, every=True).find_all(opened, targets, settings)

    @checked_keywords
    @documented_by(ExploreSettings)
    def explore(  # noqa: D417 (`documented_by`)
        self,
        picture: PictureLike,
        *,
        how: How = "auto",
        passes: int | None = None,
        shifts: int | None = None,
        seconds: float | None = None,
        duration: float | None = None,
        on_look: OnLook | None = None,
        min_gain: float | None = None,
        score_threshold: float | None = None,
        start: Start = None,
        policy: str | None = None,
        seed: int = 0,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> Record:
        """Explore a picture: learn which classes are where, without a target.

        The exploration ends when a limit is reached, or when no look is expected to gain at least `min_gain`.

        Args:
            picture: as for `search`.
            color: order of the channels of arrays and tensors, `rgb` or `bgr`.
            white: the values that are black and white, as for `search`.
            bands: the bands that are shown, as for `search`.

        Returns:
            The record, without target and decision: a `Scanpath`, a `ZoomPath` or a `HeadPath`.

        Raises:
            InputError: an argument does not fit the kind of look, or `min_gain` is given without a semantic map.
            DataError: the file of the picture cannot be read.
        """
        settings = ExploreSettings(
            how=how,
            passes=passes,
            shifts=shifts,
            seconds=seconds,
            duration=duration,
            on_look=on_look,
            start=start,
            seed=seed,
            min_gain=min_gain,
            score_threshold=score_threshold,
            policy=policy,
        )
        of_fovea = any(value is not None for value in (start, policy, shifts))
        opened = OpenedPicture.of(picture, color, white, bands)
        return self._look(opened, settings, foveal=of_fovea).explore(opened, settings)

    @checked_keywords
    def gaze(
        self,
        picture: PictureLike,
        *,
        model: FixationDensity | str | PathLike[str] | None = None,
        seen: ScanpathLike | None = None,
        quality: Quality = "quick",
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> GazePrediction:
        """Predict where people look in a picture, if they view it freely, from features that the detector computes.

        Args:
            picture: a photograph, as for `search`, or a `semfov.Panorama`.
            model: a model fitted to the detector (`semfov fit`), its file or folder; None for the one that is shipped.
            seen: fixations (also a record, or points): the prediction then uses only what the agent's fovea shows at
                them, by a pass for each (`semfov.saliency.features_so_far`). None for the sharp picture.
            quality: `quick`, one pass of the detector; or `best`, six.
            color: order of the channels of arrays and tensors, `rgb` or `bgr`.
            white: the values that are black and white, as for `search`.
            bands: the bands that are shown, as for `search`.

        Returns:
            The density of fixations, from which scanpaths are drawn.

        Raises:
            InputError: no model is shipped for the detector, `model` is of another one, or the fovea distorts places.
            DataError: the file of the picture or of the model cannot be read.
        """
        opened = OpenedPicture.of(picture, color, white, bands)
        image, size = opened.viewed(self.eye.sensor.like)
        facts: dict[str, Any] = {"source": opened.path, "size": size, "panorama": opened.is_panorama}
        return GazePrediction.of(self.eye, image, model=model, seen=seen, quality=quality, **facts)

    @checked_keywords
    @documented_by(StreamSettings)
    def live(  # noqa: D417 (`documented_by`)
        self,
        target: _Targets = None,
        *,
        how: How = "auto",
        rate: float | None = None,
        passes: int | None = None,
        start: Start = None,
        seed: int = 0,
        confirm: float | None = None,
        stop_below: float | None = None,
        closer: int | None = None,
        prior: PriorLike = None,
        score_threshold: float | None = None,
        color: Color = "rgb",
        white: White | None = None,
    ) -> LivePerception:
        """Look at a camera or a video, with one pass of the detector at every frame; old looks count less with time.

        When a place seems to hold the target, the recommended agent uses one frame for a closer look, as in `search`.

        Args:
            target: class to search for, by name or index; a list finds all objects of its classes, and None explores.
            white: the values that are black and white in frames of other types than bytes, as for `search`.

        Returns:
            An object whose `step` takes the frames one by one.

        Raises:
            InputError: a class is unknown, or an argument does not fit.
        """
        settings = StreamSettings(
            how=how,
            rate=rate,
            passes=passes,
            start=start,
            seed=seed,
            confirm=confirm,
            stop_below=stop_below,
            closer=closer,
            prior=prior,
            score_threshold=score_threshold,
            color=color,
        )
        classes = class_numbers(target, self.classes[1:], "target")
        is_one = target is not None and not isinstance(target, list | tuple)
        return LivePerception(self, classes[0] if is_one else None, () if is_one else classes, settings, white=white)

    def _look(
        self, opened: OpenedPicture, settings: LookSettings, *, every: bool = False, foveal: bool = False
    ) -> KindOfLook:
        """Choose the kind of look at a picture (`kind_of_look`), and check that the settings suit it."""
        looks = KINDS_OF_LOOK[self.kind_of_look(opened, settings.how, every=every, foveal=foveal)]
        settings.check_suitable(looks.kind)
        return looks(self)
