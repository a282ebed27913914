"""The agent: it looks at any picture, searches it for a class, finds all objects in it or explores it."""

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from os import PathLike, fspath
from typing import Any, Self, get_args

from torch import Tensor, nn

from semfov.agents.episode import EpisodeLimits, OnLook, only_for, without_none
from semfov.agents.fovea import FoveaAgent, Start
from semfov.agents.head import HeadAgent
from semfov.agents.picture import How, KindOfLook, OpenedPicture, PictureLike, check_order, counted_from
from semfov.agents.windows import ZoomAgent
from semfov.belief.grid import check_cells
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers import LearnedMap, Observer, Target
from semfov.belief.observers.any_of import TargetLike
from semfov.belief.prior import check_prior
from semfov.belief.target_evidence import TargetEvidence
from semfov.belief.verification import Verification
from semfov.data.classes import class_numbers
from semfov.data.inputs import Color
from semfov.data.tone import White
from semfov.data.windowed import ChosenBands
from semfov.decision import MOST_CLOSER, check_thresholds
from semfov.detection.load import DetectorLike, loader_options
from semfov.detection.scores import HALVES
from semfov.errors import InputError, check, check_options, checked_keywords, lookup
from semfov.eye import Eye
from semfov.gaze.policies import Policy
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.io.compatibility import check_grid, check_same_detector, check_sensor
from semfov.io.schema import is_number
from semfov.live import LivePerception
from semfov.model_folder import open_folder
from semfov.observation.foveal import FovealObservationModel
from semfov.paths import GazePrediction, Record
from semfov.paths.gaze import ScanpathLike
from semfov.presets import published_arguments, raw_arguments, recommended_arguments
from semfov.strategy import Strategy
from semfov.words import AGENT, missing
from semfov.zoom import GlimpseEvidence, WindowEye

_Targets = str | int | Sequence[str | int] | None  # a class by name or index, several of them, or None for all classes


class ActivePerception(nn.Module):
    """An agent that looks at any picture, to find a target, to find all objects, or to learn what is where.

    The picture decides how the agent looks (`how="auto"`). At a flat picture of any size it looks at windows, the first
    of them the whole picture, and chooses their places and magnifications (`windows`). In a scene, such as a
    `semfov.Panorama`, it moves eye and head (`head`). `how="fovea"` moves the gaze of a fovea over the cells of a
    photograph, as in the paper; without evidence for photographs, `auto` does so where the picture is less than four
    times as long as the detector's input. `record.how` says which it was.

    Args:
        eye: sensor and detector.
        search: observer and policy for search.
        explore: observer and policy for exploration; during a search this observer keeps the map of all classes.
        verification: probabilities after closer looks (`semfov.belief.Verification`); None searches without them.
        windows: evidence for windows (`semfov.zoom.GlimpseEvidence`); None looks at slices in the overview's order.
        grid: `(columns, rows)` of the belief, 1 to 200 each.

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
    ) -> None:
        super().__init__()
        self.eye, self.verification, self.windows = eye, verification, windows
        self.searching, self.exploring = Strategy(*search), Strategy(*explore)
        check_cells(grid)
        self.columns, self.rows = grid
        settings = eye.settings()
        for module in self.modules():
            if isinstance(module, FovealObservationModel | TargetEvidence | MapEvidence | Verification):
                check_same_detector(module.metadata.get("detector", {}), settings["detector"], module.title)
                check_sensor(module.metadata.get("sensor", {}), settings["sensor"], module.title, strict=True)
                check_grid(module.metadata.get("training", {}), grid, module.title)

    @classmethod
    def recommended(
        cls,
        name: str = "yolox-nano",
        *,
        sigma: float = 100.0,
        growth: float = 2.0,
        grid: tuple[int, int] = (10, 10),
        **options: Any,
    ) -> Self:
        """The agent for everyday use: it searches with learned target evidence and explores with a learned map.

        Args:
            name: a detector with shipped models: `yolox-nano`, `yolov3-tiny`, `nanodet-plus-m-1.5x` (with `weights=`).
            sigma: width of the fovea, in pixels of an image whose longer side is 640; the models are fitted for 100.
            growth: growth of the fovea (`Foveation`); the models are fitted for 2, and for 1 as in the paper.
            grid: `(columns, rows)` of the belief; the models are fitted on 10 x 10 cells, and hold for 5 to 20 a side.
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: no models are shipped for this detector, this sensor or this grid.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(recommended_arguments, name, sigma, growth, grid, **options)

    @classmethod
    def from_pretrained(cls, name: str | PathLike[str] = "yolox-nano", **options: Any) -> Self:
        """The agent from a folder that `semfov.fit_detector` wrote, or the recommended agent for a detector.

        Args:
            name: the folder, or the name of a detector as for `recommended`.
            options: options of `recommended`; for a folder, of `semfov.model_folder.ModelFolder.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: it is no folder, and no models are shipped for the name; the message has the commands for both.
            DataError: a file is missing or damaged, or the detector is not the one that the models were fitted to.
        """
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
        """The agent of Luzio, Bernardino and Moreno (2024), with one of the small detectors that have shipped models.

        It has 10 x 10 cells with a uniform prior of 0.5. Kaplan's rule updates every cell that a box overlaps, with
        scores calibrated by Dirichlets of maximum likelihood. Exploration maximises the Kullback-Leibler divergence.
        The paper does not give the widths of its wide and its narrow fovea; ours are 100 and 50 pixels of 640. It does
        not give a score threshold either. Ours is 0.02; for `threshold=` 0.1, 0.25 and 0.5 the wide fovea has models
        that are fitted at them. Its detector is YOLOv3, larger than ours. With a folder of models, detector, sensor,
        grid and observation model are those of the folder.

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
        """An agent for any detector, without fitted models: raw scores as likelihoods, and random exploration.

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
    def _of(cls, make: Callable[..., dict[str, Any]], /, *given: Any, **options: Any) -> Self:
        """The agent with the parts that a function makes from the options of a constructor, ready for use."""
        known = [each for each in (*signature(make).parameters, *loader_options()) if each != "options"]
        check_options(options, known, "the agent or of semfov.load_detector")
        return cls(**make(*given, **options)).eval().requires_grad_(False)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move or convert the agent; half precision is for the detector alone, as beliefs and decisions need more."""
        self.eye.detector.check_conversion(fn)

        def precise(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return tensor.to(moved.device) if moved.dtype in HALVES else moved

        super()._apply(precise, recurse)
        self.eye.detector._apply(fn, recurse)
        return self

    def __getattr__(self, name: str) -> Any:
        """The parts of the module; other libraries' words for what an agent does are refused with its own."""
        if name in AGENT:
            raise missing("an agent", name, AGENT)
        return super().__getattr__(name)

    def __call__(self, *given: Any, **options: Any) -> Any:
        if type(self).forward is nn.Module.forward:
            raise InputError("an agent is not called itself: it has search, find_all, explore, gaze and live")
        return super().__call__(*given, **options)

    def __repr__(self) -> str:
        """The detector, the sensor and the parts that were fitted, in one line."""
        fitted = [name for name in ("windows", "verification") if getattr(self, name) is not None]
        eye, sensor = f"{self.eye.detector.settings()['name']}, {len(self.classes) - 1} classes", type(self.eye.sensor)
        return f"{type(self).__name__}({eye}, {sensor.__name__}, cells={(self.columns, self.rows)}, fitted={fitted})"

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
        return ZoomAgent(WindowEye(self.eye.detector), self.windows).train(self.training)

    @property
    def head(self) -> HeadAgent:
        """The part of the agent that turns a head in a scene.

        Raises:
            InputError: the agent has no learned evidence and map for its sensor.
        """
        search, explore = self.searching.observer, self.exploring.observer
        if not (isinstance(search, Target) and isinstance(explore, LearnedMap)):
            got = f"{type(search).__name__} and {type(explore).__name__}"
            remedy = "use ActivePerception.recommended, or fit them to your detector (semfov fit)"
            raise InputError(f"how: expected an agent with learned evidence and map for a head, got {got}; {remedy}")
        return HeadAgent(self.eye, search.model, explore.model)

    def kind_of_look(
        self, picture: PictureLike | OpenedPicture, how: How = "auto", *, every: bool = False, foveal: bool = False
    ) -> KindOfLook:
        """How the agent looks at a picture.

        Args:
            picture: as for `search`, or one that is opened.
            how: `auto` chooses by the picture; another kind is returned, if it suits the picture.
            every: whether all objects are wanted.
            foveal: whether a fovea is asked for: by several classes, a first cell, gaze shifts or true boxes.

        Returns:
            `fovea`, `windows` or `head`.

        Raises:
            InputError: the kind is unknown, or does not suit a scene.
        """
        known = not foveal and self.windows is not None and self.windows.photograph is not None
        return OpenedPicture.of(picture).kind(how, self.eye.detector.input_size, every=every, photographs=known)

    @checked_keywords
    def search(
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
        give_up: float | None = None,
        closer: int | None = None,
        prior: float | None = None,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> Record:
        """Search a picture for a target class, and decide whether it is there (`record.decision`).

        The recommended agent looks closely at places that seem to hold the target: it enlarges a window around them to
        the detector's input (`semfov.decision.Verifier`). The search ends with `found` when the target is probable
        enough at such a place. It ends without the target when no remaining look is worth a pass, and at the first
        limit that is reached.

        Without closer looks the search ends with `found` when the picture holds the target with enough probability, and
        a fixated cell is nearly as probable as the most probable one (`semfov.decision.decide`).

        By Kaplan's rule, which has no calibrated thresholds, a search never gives up. It finds the target when a
        detection that overlaps the fixated cell has it as its best class, with a score of at least `confirm`.

        With `boxes`, as in the paper, the search makes no decision. It ends with the gaze on a cell that a box meets.

        Args:
            picture: a picture of any common kind and size (`semfov.as_image`): a path, a Pillow image, an array or a
                tensor; a `semfov.data.windowed.LargePicture`; or a scene: a `semfov.Panorama`, a
                `semfov.Flat`, or a camera that turns (`semfov.head.PanTiltCamera`).
            target: class by name or index 1..K. A fovea also takes several: with `how="fovea"` in a list, of which any
                will do, or each with the probability that it is meant (`AnyOf`, `semfov.data.spread`). The target of
                the record is then the most probable of them.
            how: the kind of look, `fovea`, `windows` or `head`; `auto` chooses it by the picture.
            passes: largest number of passes of the detector, closer looks included; None takes 24, and 40 for a head.
            shifts: largest number of gaze shifts of a fovea, 0 to 10,000; None takes 30, or with `passes` no limit.
            seconds: longest time in seconds on this machine.
            duration: in a scene, longest time in seconds that the movements of eye and head take; None takes 30.
            on_look: called after each look with the record so far; returning False ends the search.
            start: first cell of a fovea, by its number or as `(column, row)`, or first action of a head
                (`semfov.head.views.Views`); None draws the cell at random, and looks straight ahead.
            seed: seed of the generator that draws the start and breaks ties.
            boxes: `(M, 4)`, true boxes `(x1, y1, x2, y2)` of the target in pixels of a photograph.
            confirm: least probability for `found`: with closer looks, that the target is at the place; otherwise, that
                the picture holds it. None takes the threshold that was chosen when the model was fitted, or a score of
                0.5 for a belief without thresholds.
            give_up: probability below which a look is not worth a pass; None takes the threshold of the model.
            closer: largest number of closer looks, 0 to 100, each a pass of the detector. None takes 3 in a photograph,
                all that there are passes for in a large picture, 2 for a fovea. 0, and no verification, make none.
            prior: share of your pictures that hold the target, such as 0.15, which probabilities follow; None is half.
            color: order of the channels of arrays and tensors, `rgb`, or `bgr` as OpenCV reads them.
            white: the value that is white where 0 is black, `(black, white)`, or `auto` for percentiles (`read_image`).
            bands: bands of a TIFF or a raster that are red, green and blue, from 1, or one as grey; None: as named.

        Returns:
            The record, with its decision: a `Scanpath`, a `ZoomPath` or a `HeadPath`.

        Raises:
            InputError: the class is unknown (near names are suggested), or an argument does not fit the kind of look.
            DataError: the file of the picture cannot be read.
        """
        check_order(picture, target, self.classes[1:])
        check_thresholds(confirm, give_up, closer)
        check_prior(prior)
        # Class numbers may be those of NumPy or a tensor, which have no length.
        targets = [target] if isinstance(target, str) or not isinstance(target, Mapping | Sequence) else list(target)
        foveal = start is not None or boxes is not None
        listed = len(targets) > 1 and not isinstance(target, Mapping)
        several = "one class; find_all takes several, and how='fovea' searches for any of them"
        check(not listed or how != "auto" or foveal or shifts is not None, "target", several, target)
        foveal |= len(targets) > 1
        opened, kind = self._open(picture, how, shifts, duration, color, white, bands, foveal=foveal)
        limits: dict[str, Any] = {"passes": passes, "seconds": seconds, "on_look": on_look}
        only_for(kind, "fovea", "passes", boxes=boxes)
        if kind == "fovea":
            image, bounds = opened.image(self.eye.sensor.like), EpisodeLimits(**limits)
            settings: dict[str, Any] = {"start": start, "seed": seed, "boxes": boxes, "confirm": confirm}
            settings |= {"give_up": give_up, "shifts": shifts, "prior": prior}
            most = MOST_CLOSER if closer is None else closer
            return opened.named(self.fovea.search(image, target, bounds, closer=most, **settings))
        several = "one class for a search by windows or a head; find_all takes several"
        check(len(targets) == 1, "target", several, target)
        arguments = without_none(confirm=confirm, give_up=give_up, prior=prior, **limits)
        if kind == "head":
            only_for(kind, "fovea", "confirm", closer=closer)
            arguments |= without_none(start=start, duration=duration)
            return self.head.search(opened.world, targets[0], seed=seed, **arguments)
        only_for(kind, "fovea", "none", start=start)
        return self.zoom.search(opened.large, targets[0], **without_none(closer=closer), **arguments)

    @checked_keywords
    def find_all(
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
        worth: float | None = None,
        least: float | None = None,
        batch: int = 1,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> Record:
        """Find all objects of a class, of several or of all classes (`record.objects`, `record.expected`).

        The first look is the whole picture. Each other look is a window at the magnification with the largest expected
        number of new objects. A picture that fits the detector's input needs few more looks than the first.

        Args:
            picture: as for `search`.
            target: class by name or index 1..K, several in a list, or None for all classes.
            how: the kind of look, as for `search`; `auto` looks at windows, or moves the head in a scene.
            passes: largest number of passes of the detector; None takes 24, and 40 for a head.
            shifts: largest number of gaze shifts of a fovea; None takes 20, or with `passes` no limit.
            seconds: longest time in seconds on this machine.
            duration: in a scene, longest time in seconds that the movements of eye and head take.
            on_look: called after each look with the record so far; returning False ends it.
            worth: least gain of a look: of windows new objects (None: 0.01), of a head further right cells (None: 0).
            least: score from which on an object counts; in windows, and for None, as for `ZoomAgent.find_all`.
            batch: number of windows that are chosen jointly and pass the detector together.
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
        opened, kind = self._open(picture, how, shifts, duration, color, white, bands, every=True)
        limits: dict[str, Any] = {"passes": passes, "seconds": seconds, "on_look": on_look}
        if kind == "fovea":
            only_for(kind, "windows", "passes", worth=worth)
            image, bounds = opened.image(self.eye.sensor.like), EpisodeLimits(**limits)
            return counted_from(opened.named(self.fovea.find_all(image, targets, bounds, shifts=shifts)), least)
        arguments = without_none(worth=worth, **limits)
        if kind == "head":
            arguments |= without_none(duration=duration)
            return counted_from(self.head.find_all(opened.world, targets or None, **arguments), least)
        aim = targets[0] if len(targets) == 1 else list(targets) or None
        return self.zoom.find_all(opened.large, aim, batch=batch, **without_none(least=least), **arguments)

    @checked_keywords
    def explore(
        self,
        picture: PictureLike,
        *,
        how: How = "auto",
        passes: int | None = None,
        shifts: int | None = None,
        seconds: float | None = None,
        duration: float | None = None,
        on_look: OnLook | None = None,
        worth: float | None = None,
        least: float | None = None,
        start: Start = None,
        policy: str | None = None,
        seed: int = 0,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> Record:
        """Explore a picture: learn which classes are where, without a target.

        It ends at the first limit that is reached, or when no look is expected to gain at least `worth`.

        Args:
            picture: as for `search`.
            how: the kind of look, as for `search`.
            passes: largest number of passes of the detector; None takes 24 for windows and 40 for a head.
            shifts: largest number of gaze shifts of a fovea, 0 to 10,000; None takes 20, or with `passes` no limit.
            seconds: longest time in seconds on this machine.
            duration: in a scene, longest time in seconds that the movements of eye and head take; None takes 30.
            on_look: called after each look with the record so far; returning False ends the exploration.
            worth: least expected gain of a look: of a fovea with a learned map (None takes 0.1) or of a head the
                further right cells, of windows the new objects (None takes 0.01). 0 makes all looks.
            least: score or probability from which on an object counts, as for `find_all`.
            start: first cell of a fovea or first action of a head, as for `search`.
            policy: `people` moves a fovea as people move their gaze (`semfov.gaze.Viewer`); None as the agent does.
            seed: seed of the generator that draws the start and breaks ties.
            color: order of the channels of arrays and tensors, `rgb` or `bgr`.
            white: the values that are black and white, as for `search`.
            bands: the bands that are shown, as for `search`.

        Returns:
            The record, without target and decision: a `Scanpath`, a `ZoomPath` or a `HeadPath`.

        Raises:
            InputError: an argument does not fit the kind of look, or `worth` is given without a learned map.
            DataError: the file of the picture cannot be read.
        """
        check(worth is None or (is_number(worth) and worth >= 0), "worth", "0 or more, or None", worth)
        foveal = start is not None or policy is not None
        opened, kind = self._open(picture, how, shifts, duration, color, white, bands, foveal=foveal)
        only_for(kind, "fovea", "none", policy=policy)
        if kind == "fovea":
            given: dict[str, Any] = {"start": start, "shifts": shifts, "seed": seed, "worth": worth, "policy": policy}
            seen, bounds = opened.image(self.eye.sensor.like), EpisodeLimits(passes, seconds, on_look)
            return counted_from(opened.named(self.fovea.explore(seen, bounds, **given)), least)
        arguments = without_none(worth=worth, passes=passes, seconds=seconds, on_look=on_look)
        if kind == "head":
            arguments |= without_none(start=start, duration=duration)
            return counted_from(self.head.explore(opened.world, seed=seed, **arguments), least)
        only_for(kind, "fovea", "none", start=start)
        return self.zoom.explore(opened.large, **without_none(least=least), **arguments)

    @checked_keywords
    def gaze(
        self,
        picture: PictureLike,
        *,
        model: FixationDensity | str | PathLike[str] | None = None,
        seen: ScanpathLike | None = None,
        color: Color = "rgb",
        white: White | None = None,
        bands: ChosenBands = None,
    ) -> GazePrediction:
        """Predict where people look in a picture that they view freely, from the features of one pass of the detector.

        Args:
            picture: a photograph, as for `search`.
            model: a model fitted to the detector (`semfov fit`), its file or folder; None for the one that is shipped.
            seen: fixations, a record, or points, a pass for each; the prediction then knows only what the agent's fovea
                has shown at them (`semfov.saliency.features_so_far`). None for the sharp picture.
            color: order of the channels of arrays and tensors, `rgb` or `bgr`.
            white: the values that are black and white, as for `search`.
            bands: the bands that are shown, as for `search`.

        Returns:
            The density of fixations, from which scanpaths are drawn.

        Raises:
            InputError: no model is shipped for the detector, the given one is another's, or the fovea bends it.
            DataError: the file of the picture or of the model cannot be read.
        """
        opened = OpenedPicture.of(picture, color, white, bands)
        image = opened.image(self.eye.sensor.like)[0]
        return GazePrediction.of(self.eye, image, model=model, source=opened.path, seen=seen)

    @checked_keywords
    def live(
        self,
        target: _Targets = None,
        *,
        how: How = "auto",
        rate: float | None = None,
        start: int | None = None,
        seed: int = 0,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int | None = None,
        prior: float | None = None,
        color: Color = "rgb",
        white: White | None = None,
    ) -> LivePerception:
        """Look at a camera or a video: one pass of the detector for every frame, and evidence that fades between them.

        When a place seems to hold the target, the recommended agent spends a frame on a closer look (`search`).

        Args:
            target: class to search for, by name or index; a list finds all objects of its classes, and None explores.
            how: the kind of look, `fovea` or `windows`; `auto` looks at windows (`semfov.live.LivePerception`).
            rate: rate at which evidence fades, per second; 0 forgets nothing; None takes 2.5, and 0.75 for windows.
            start: first cell of a fovea; None draws one at random.
            seed: seed of the generator that draws the start and breaks ties.
            confirm: least probability for `found`, as for `search`; None takes that of the model.
            give_up: probability below which a look is not worth a frame; None takes that of the belief alone, as a
                belief that fades can reach it, or with rate 0 that of `search`.
            closer: largest number of closer looks, 0 to 100, in ln 2 / rate seconds; None takes that of `search`.
            prior: how often the target is there, as a share of frames; None assumes half of them.
            color: order of the channels of frames that are arrays or tensors, `rgb`, or `bgr` as OpenCV reads them.
            white: the values that are black and white in frames of other types than bytes, as for `search`.

        Returns:
            An object whose `step` takes the frames one by one.

        Raises:
            InputError: a class is unknown, or an argument does not fit.
        """
        numbers, one = class_numbers(target, self.classes[1:], "target"), not isinstance(target, list | tuple)
        check_thresholds(confirm, give_up, closer)
        sought, found = numbers[0] if numbers and one else None, () if one else numbers
        check(prior is None or (one and len(numbers) > 0), "prior", "None without one class to search for", prior)
        settings: dict[str, Any] = {"confirm": confirm, "give_up": give_up, "closer": closer, "prior": prior}
        settings |= {"how": lookup(how, get_args(How), "kind of look"), "rate": rate, "start": start, "seed": seed}
        return LivePerception(self.fovea, self.zoom, sought, found, white=white, color=color, **settings)

    def _open(
        self, picture: PictureLike, how: How, shifts: int | None, duration: float | None, *given: Any, **wanted: bool
    ) -> tuple[OpenedPicture, KindOfLook]:
        """Open a picture, choose the kind of look (`kind_of_look`), and check the limits that suit it."""
        opened, foveal = OpenedPicture.of(picture, *given), wanted.pop("foveal", False) or shifts is not None
        kind = self.kind_of_look(opened, how, foveal=foveal, **wanted)
        only_for(kind, "fovea", "passes=", shifts=shifts)
        only_for(kind, "head", "seconds=", duration=duration)
        return opened, kind
