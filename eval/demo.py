"""See what the agent does: `python -m eval.demo PHOTO.jpg --target cup` searches a photograph and draws the search.

    python -m eval.demo                                  # lists the classes that can be searched for
    python -m eval.demo --target cup                     # an embedded scene, no photograph needed
    python -m eval.demo PHOTO.jpg --target "wine glass"  # your own photograph, or a folder or a video
    python -m eval.demo PHOTO.jpg --target "something to drink from" --embeddings glove.6B.300d.txt
    python -m eval.demo PHOTO.jpg --explore              # no target: learn what is where
    python -m eval.demo --camera 0 --target cup          # live, from a camera, until Ctrl-C
    python -m eval.demo PHOTO.jpg --target cup --report cup.html
    python -m eval.demo PHOTO.jpg --target cup --models mymodels    # your own detector, after train.fit_detector

It prints the detections and the belief at each fixation, and writes pictures and an animation to the folder `out`.
`--draw` chooses which (`--draw "[scanpath]"`; `--draw "[]"` for none).
Each picture of a folder is a separate episode. In a video or from a camera, the agent makes one gaze shift or one
closer look per frame; the belief is carried from frame to frame and fades at a given rate. In a picture that is at
least four times as large as the detector's input, the agent looks at windows and chooses their places and
magnifications.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

import semfov
from eval.demo_tables import columns, path_table, plain_name
from eval.stream import watch
from semfov import ActivePerception, Scanpath, viz
from semfov.agents import ZoomAgent
from semfov.data.classes import class_index
from semfov.data.sources import Picture, Stream, embedded_picture, is_video, open_pictures, open_stream
from semfov.data.word_vectors import WordVectors, spread
from semfov.decision import MOST_CLOSER
from semfov.detection.load import check_detector
from semfov.errors import InputError, check
from semfov.io.manifest import Manifest
from semfov.live import RATE
from semfov.paths import ZoomPath
from semfov.paths.stimulus import reduced
from semfov.report import Pool, episode_data, write_page, zoom_data
from semfov.runs.command import run_command
from semfov.runs.settings import Range, Seed, Settings, Share, Shifts, Weight, Whole
from semfov.sensor import SENSORS, Foveation
from semfov.sensor.named import SensorName
from semfov.viz.animation import film_of
from semfov.zoom import GlimpseEvidence, WindowEye

_Drawing = Literal["scanpath", "views", "belief", "belief_bars", "animation"]

LIVE = ("rate", "start", "seed", "confirm", "give_up", "closer")
"""Settings that a video or camera takes, too."""

PHOTO = "photograph, folder of photographs or video (none: an embedded scene)"


@dataclass(frozen=True)
class DemoConfig(Settings):
    """Watch the agent search a photograph for a class, or explore it.

    Args:
        photo: photograph, folder of photographs or video (none: an embedded scene).
        target: class to search for; without it and without --explore, the classes are listed.
        embeddings: file of word vectors (text format of GloVe or word2vec); a target that is not a class of the
            detector is then spread over the classes closest in meaning.
        explore: explore the scene, without a target.
        camera: number of a camera whose frames are looked at.
        agent: `recommended` (learned models, if they are shipped for the detector), `published` (the paper's:
            calibrated scores, Kaplan's rule, predictive search, Kullback-Leibler exploration) or `raw` (any detector,
            no model: scores as they are, fixates where the target is most probable).
        detector: name or file, as for `semfov.load_detector`; with `models`, the new location of the detector's file.
        models: folder of models for your own detector, from `train.fit_detector`; it defines detector and sensor.
        sensor: `gradual` (the recommended agent's), `published` or `published-narrow` (`semfov.sensor.SENSORS`; none:
            the agent's own).
        start: first cell, numbered row by row (none: drawn at random).
        shifts: largest number of gaze shifts (none: 30 for a search, 20 for an exploration).
        confirm: the target counts as found when its probability reaches this value: at the place of a closer look, or
            in the picture for a search without closer looks (none: the value chosen when the model was fitted; for
            agents without a fitted belief, a detection's score of 0.5).
        give_up: a search gives up when, in every cell not fixated yet, the probability of the target is below this
            value (none: the value chosen when the belief was fitted).
        closer: largest number of closer looks, in which a window around a place that seems to hold the target is
            enlarged to the detector's input; 0: none. In a video or from a camera, a closer look takes the place of a
            look, and the number holds for the time until half of the belief has faded. In a large picture each takes
            one of the passes.
        until: price of a look in cells: an exploration ends when no look is expected to name this many more cells right
            (none: 0.1 if the map was learned; 0: never). In a large picture, price in objects: it ends when no window
            is expected to show this many new objects (none: 0.01).
        seed: random seed of the start, of ties and of the embedded scene.
        frames: number of frames of a video or camera to look at (none: the whole video; a camera until Ctrl-C).
        rate: rate at which the belief about a video or camera fades from frame to frame (0: never).
        report: HTML file to write: a page in which to step through the episodes, or through the looks at large
            pictures.
        draw: figures to draw: `scanpath` (of a large picture: its windows), `views` (the foveated views), `belief` (in
            an exploration: the map of what is where), `belief_bars` and `animation`; `[]` draws nothing.
        out: folder for pictures and animations.
    """

    photo: Path | None = None
    target: str | None = None
    embeddings: Path | None = None
    explore: bool = False
    camera: Whole | None = None
    agent: Literal["recommended", "published", "raw"] = "recommended"
    detector: str = "yolov3-tiny"
    models: Path | None = None
    sensor: SensorName | None = None
    start: Whole | None = None
    shifts: Shifts | None = None
    confirm: Share | None = None
    give_up: Share | None = None
    closer: Annotated[int, Range(0, 100)] = MOST_CLOSER
    until: Weight | None = None
    seed: Seed = 0
    frames: Annotated[int, Range(1, 10**9)] | None = None
    rate: Annotated[float, Range(0, 100)] = RATE
    report: Path | None = None
    draw: tuple[_Drawing, ...] = ("scanpath", "views", "belief", "animation")
    out: Path = Path("runs/demo")


def demo(config: DemoConfig) -> None:
    """Look at every picture, and print and draw the episodes."""
    check(config.target is None or not config.explore, "target", "none with --explore", config.target)
    check(config.photo is None or config.camera is None, "photo", "none with --camera", config.photo)
    # Errors in the arguments are reported, as far as possible, before anything is loaded.
    classes = known_classes(config)
    agent = None if classes is not None else make_agent(config)
    classes = agent.classes[1:] if agent is not None else classes or ()
    if config.target is None and not config.explore:
        print(f"Choose a class with --target, or --explore. {config.models or config.detector} knows:\n")
        print(columns(classes))
        return
    wanted: dict[str, float] = {}
    if config.target is not None:
        wanted = meant(config, classes)
        config = replace(config, target=next(iter(wanted)))
    stream = open_live(config)
    watched = with_first_read(pictures(config, classes)) if stream is None else iter(())
    agent = make_agent(config) if agent is None else agent
    if stream is not None:
        only_likeliest(wanted)
        given = {name: getattr(config, name) for name in LIVE}
        path = watch(agent.live(config.target, **given), stream, config.out / "live")
        print(f"written:\n  {path}")
        return
    written, pool, episodes = [], Pool(), []
    several = config.photo is not None and config.photo.is_dir()
    zooming = zoom_agent(config, agent)
    for number, picture in enumerate(watched):
        if zooming is not None and zooming.pays(picture.image):
            folder = config.out / f"{number:03d}-{plain_name(picture.name)}" if several else config.out
            only_likeliest(wanted)
            zoomed = zoom_in(zooming, picture, config)
            if "scanpath" in config.draw:
                small = reduced(picture.image).clamp(0, 1)
                written.append(viz.save_figure(viz.plot_zoom_path(zoomed, small), folder / "zoom.png"))
            if config.report is not None:
                settings = zooming.eye.settings()
                episodes.append(zoom_data(zoomed, picture.image, pool, name=picture.name, settings=settings))
            continue
        scanpath = look_at(agent, picture, config, wanted)
        print(path_table(picture.name, scanpath))
        folder = config.out / f"{number:03d}-{plain_name(picture.name)}" if several else config.out
        views = views_to_draw(scanpath, config)
        written += draw(folder, scanpath, picture, views, config.draw)
        if config.report is not None:
            episodes.append(episode_data(scanpath, scanpath.image, views, pool, name=picture.name, boxes=picture.boxes))
    if config.report is not None and episodes:
        title = "exploration" if config.target is None else f"search for “{config.target}”"
        written.append(write_page(config.report, f"semfov: {title}", episodes, pool))
    print("written:")
    for path in written:
        print(f"  {path}")


def make_agent(config: DemoConfig) -> ActivePerception:
    """The agent that the settings name."""
    if config.models is not None:
        own = ActivePerception.published if config.agent == "published" else ActivePerception.from_pretrained
        return own(config.models, **moved(config.detector))
    if config.agent == "recommended":
        sensor = SENSORS[config.sensor or "gradual"]
        kind = sensor.make.__name__
        check(sensor.make is Foveation, "sensor", "a Foveation, since models are shipped for no other sensor", kind)
        shape = {name: sensor.settings[name] for name in ("sigma", "growth")}
        return ActivePerception.recommended(config.detector, **shape)
    make = ActivePerception.published if config.agent == "published" else ActivePerception.raw
    return make(config.detector, sensor=config.sensor or "published")


def moved(detector: str) -> dict[str, Any]:
    """The new location of the detector of a folder of models, if the settings give one."""
    return {} if detector == DemoConfig().detector else {"detector": detector}


def zoom_agent(config: DemoConfig, agent: ActivePerception) -> ZoomAgent | None:
    """The agent for large pictures, with the same detector; None if no evidence is shipped for the detector."""
    name = agent.eye.detector.name
    if config.agent != "recommended" or not (GlimpseEvidence.shipped / f"{name}.safetensors").is_file():
        return None
    zooming = ZoomAgent(WindowEye(agent.eye.detector), GlimpseEvidence.from_pretrained(name))
    return zooming.eval().requires_grad_(False)


def zoom_in(agent: ZoomAgent, picture: Picture, config: DemoConfig) -> ZoomPath:
    """Search or explore a picture larger than the detector's input, and print its windows.

    Args:
        agent: the agent for large pictures.
        picture: the picture.
        config: the settings.

    Returns:
        The path.
    """
    passes = 24 if config.shifts is None else config.shifts + 1
    if config.target is None:
        given = {"worth": config.until}
        path = agent.explore(picture.image, passes=passes, **chosen(given))
    else:
        given = {"confirm": config.confirm, "give_up": config.give_up}
        path = agent.search(picture.image, config.target, passes=passes, closer=config.closer, **chosen(given))
    width, height = path.lattice.size
    print(f"{picture.name}, {width} × {height} px, looked at in windows: {path.summary()}")
    unused = [name for name in ("sensor", "start") if getattr(config, name) is not None]
    if unused:
        print(f"  ignored for a picture of this size: {', '.join(unused)}")
    closer = {look.number: f"; closer look: p {look.place:.3f} there" for look in path.closer}
    for number, glance in enumerate(path.glances):
        x, y, magnification = glance.window.fixation
        count = int((glance.detections.confidence >= viz.CONFIDENT).sum())
        where = f"at ({x:.0f}, {y:.0f})" if number else "the whole picture"
        told = f"{count} detection{'s' if count != 1 else ''}{closer.get(number, '')}"
        print(f"  {number:2d}  {where} × {magnification:.2f}: {told}")
    return path


def chosen(values: dict[str, float | None]) -> dict[str, Any]:
    """The values that were given."""
    return {name: value for name, value in values.items() if value is not None}


def known_classes(config: DemoConfig) -> tuple[str, ...] | None:
    """The detector's classes, if they are known before it is loaded."""
    return check_detector(config.detector) if config.models is None else Manifest.read(config.models).classes


def open_live(config: DemoConfig) -> Stream | None:
    """Open the video or the camera that the settings name; None if they name neither."""
    source = config.camera if config.photo is None else config.photo if is_video(config.photo) else None
    if source is None:
        return None
    for name in ("shifts", "until", "report"):
        value = getattr(config, name)
        check(value is None, name, "none for a video or a camera, which ends with its --frames", value)
    return open_stream(source, config.frames)


def pictures(config: DemoConfig, classes: Sequence[str]) -> Iterator[Picture]:
    """The pictures that the settings name."""
    if config.photo is None:
        yield embedded_picture(classes, config.target, config.seed)
    else:
        yield from open_pictures(config.photo)


def with_first_read(pictures: Iterator[Picture]) -> Iterator[Picture]:
    """The same pictures; the first is read immediately, so that errors appear early."""
    first = next(pictures)
    return chain([first], pictures)


def meant(config: DemoConfig, classes: Sequence[str]) -> dict[str, float]:
    """The classes that a target may mean, each with a weight, the most likely first."""
    target = config.target or ""
    try:
        return {classes[class_index(target, classes, "target") - 1]: 1.0}
    except InputError as error:
        if config.embeddings is None:
            raise InputError(f"{error}; a description needs --embeddings, a file of word vectors") from None
    vectors = WordVectors.read(config.embeddings, [target, *classes])
    found = spread(target, classes, vectors)
    print(f"“{target}” may mean: {', '.join(f'{name} {weight:.2f}' for name, weight in found.items())}")
    if vectors.missing:
        print(f"  words without a vector in {config.embeddings}: {', '.join(vectors.missing)}")
    return found


def only_likeliest(wanted: dict[str, float]) -> None:
    """Tell the user if only the most likely class of a description is searched for."""
    if len(wanted) > 1:
        print(f"videos, cameras and large pictures are searched only for the most likely class: {next(iter(wanted))}")


def look_at(
    agent: ActivePerception, picture: Picture, config: DemoConfig, wanted: dict[str, float] | None = None
) -> Scanpath:
    """Search or explore a picture."""
    common: dict[str, Any] = {"start": start_cell(agent, picture, config), "seed": config.seed}
    with torch.inference_mode():
        if config.target is None:
            shifts = 20 if config.shifts is None else config.shifts
            explored = agent.explore(picture.image, how="fovea", shifts=shifts, worth=config.until, **common)
            assert isinstance(explored, Scanpath)
            return explored
        shifts = 30 if config.shifts is None else config.shifts
        common |= {"confirm": config.confirm, "give_up": config.give_up}
        common["closer"] = config.closer
        target = wanted if wanted and len(wanted) > 1 else config.target
        searched = agent.search(picture.image, target, how="fovea", shifts=shifts, **common)
        assert isinstance(searched, Scanpath)
        return searched


def start_cell(agent: ActivePerception, picture: Picture, config: DemoConfig) -> int | None:
    """The first cell: the given one, or a random one off the target if its place is known; None: the agent draws."""
    if config.start is not None or picture.boxes is None:
        return config.start
    grid = semfov.Grid(agent.columns, agent.rows, (picture.image.shape[-1], picture.image.shape[-2]))
    free = (~grid.footprint(picture.boxes).any(0)).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(config.seed)
    return int(free[torch.randint(len(free), (1,), generator=generator)]) if len(free) else None


def views_to_draw(scanpath: Scanpath, config: DemoConfig) -> list[Tensor]:
    """The foveated view at each fixation; empty if no wanted figure needs it."""
    needed = config.report is not None or {"views", "animation"} & set(config.draw)
    return scanpath.views() if needed else []


def draw(
    folder: Path, scanpath: Scanpath, picture: Picture, views: list[Tensor], wanted: Sequence[_Drawing]
) -> list[Path]:
    """Write the wanted figures and animation of an episode."""
    boxes, searched = picture.boxes, scanpath.target is not None
    figures: dict[str, Callable[[], Any]] = {
        "scanpath": lambda: viz.plot_scanpath(scanpath, boxes=boxes),
        "views": lambda: viz.plot_foveated_strip(scanpath, views),
    }
    if searched:
        figures["belief"] = lambda: viz.plot_belief_strip(scanpath)
        figures["belief_bars"] = lambda: viz.plot_belief_bars(scanpath)
    else:
        figures["map"] = lambda: viz.plot_semantic_map(scanpath)
    names = [name if searched or name != "belief" else "map" for name in wanted]
    written = [viz.save_figure(figures[name](), folder / f"{name}.png") for name in names if name in figures]
    if "animation" in wanted:
        film = film_of(scanpath, views=views, boxes=boxes)
        written += film.save(folder / "animation.gif")
    return written


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    # A flag needs no value.
    given = ["--explore=true" if argument == "--explore" else argument for argument in given]
    return run_command(demo, DemoConfig, __doc__, given, positional=("photo", PHOTO))


if __name__ == "__main__":
    sys.exit(main())
