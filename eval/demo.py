"""See what the agent does: `python -m eval.demo PHOTO.jpg --target cup` searches a photograph and draws everything.

    python -m eval.demo                                  # lists the classes that can be searched for
    python -m eval.demo --target cup                     # an embedded scene, no photograph needed
    python -m eval.demo PHOTO.jpg --target "wine glass"  # your own photograph; a folder or a video will do, too
    python -m eval.demo PHOTO.jpg --explore              # no target: learn what is where
    python -m eval.demo --camera 0 --target cup          # live, from a camera, until Ctrl-C
    python -m eval.demo PHOTO.jpg --target cup --report cup.html
    python -m eval.demo PHOTO.jpg --target cup --models mymodels    # your own detector, after train.fit_detector

It prints what was seen and believed at each fixation, and writes pictures and an animation to the folder `out`: those
that `--draw` names (`--draw "[scanpath]"`, `--draw "[]"` for none).
Each picture of a folder is looked at on its own. The frames of a video or a camera are looked at as they come, one gaze
shift a frame: belief goes on from frame to frame and fades at a rate. A picture that is four times as large as the
detector's input, or larger, is looked at in windows: the agent chooses where, and how close.
"""

import re
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from torch import Tensor

import semfov
from eval.stream import watch
from semfov import ActivePerception, Scanpath, viz
from semfov.data.classes import class_index
from semfov.data.sources import Picture, Stream, embedded_picture, is_video, open_pictures, open_stream
from semfov.detection.load import check_detector
from semfov.errors import check
from semfov.experiments.command import run_command
from semfov.experiments.settings import Range, Seed, Settings, Share, Shifts, Weight, Whole
from semfov.io.manifest import Manifest
from semfov.live import RATE
from semfov.report.episode import Pool, episode_data
from semfov.report.page import write_page
from semfov.scanpath.stimulus import reduced
from semfov.sensor import SENSORS
from semfov.sensor.named import SensorName
from semfov.viz.animation import film_of
from semfov.viz.zoom import describe_zoom
from semfov.zoom import GlimpseEvidence, ZoomAgent, ZoomEye

Drawn = Literal["scanpath", "views", "belief", "belief_bars", "animation"]

PHOTO = "photograph, folder of photographs or video (none: an embedded scene)"


@dataclass(frozen=True)
class DemoConfig(Settings):
    """Watch the agent search a photograph for a class, or explore it.

    Args:
        photo: photograph, folder of photographs or video (none: an embedded scene).
        target: class to search for; none, and no --explore, lists the classes.
        explore: look around without a target.
        camera: look at what the camera of this number shows.
        agent: `recommended` (learned models, where they are shipped for the detector), `published` (the paper's:
            calibrated scores, Kaplan's rule, predictive search, Kullback-Leibler exploration) or `raw` (any detector,
            no model: scores as they are, looks where the target is most probable).
        detector: name or file, as for `semfov.load_detector`; with `models`, where the detector's file lies now.
        models: folder of models of your own detector, from `train.fit_detector`; it names detector and sensor.
        sensor: `gradual` (the recommended agent's), `published` or `published-narrow` (`semfov.sensor.SENSORS`); none
            takes the agent's own.
        start: first cell, numbered row by row (none: drawn at random).
        shifts: most gaze shifts (none: 30 for a search, 20 for an exploration).
        confirm: probability that the target is there, from which on it counts as found (none: the one chosen when the
            belief was fitted; for agents without a fitted belief the score of a detection, 0.5).
        give_up: probability below which a cell is not worth a look (none: the one chosen).
        price: price of a look in right decisions: a search ends when looking on is not worth it (none: by thresholds).
        until: price of a look in cells: an exploration ends when none is expected to name so many more right (none: 0.1
            where the map was learned; 0: never). Of a large picture in objects: when no window is expected to show so
            many new ones (none: 0.01).
        seed: of the start, of ties and of the embedded scene.
        frames: how many frames of a video or camera to look at (none: all of a video, of a camera until Ctrl-C).
        rate: at which the belief about a video or camera fades from frame to frame (0: never).
        report: write a page to step through in a browser to this file.
        draw: what to draw: `scanpath`, `views` (what the eye saw), `belief` (of an exploration: what is where),
            `belief_bars` and `animation`; `[]` draws nothing.
        out: folder for pictures and animations.
    """

    photo: Path | None = None
    target: str | None = None
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
    price: Weight | None = None
    until: Weight | None = None
    seed: Seed = 0
    frames: Annotated[int, Range(1, 10**9)] | None = None
    rate: Annotated[float, Range(0, 100)] = RATE
    report: Path | None = None
    draw: tuple[Drawn, ...] = ("scanpath", "views", "belief", "animation")
    out: Path = Path("runs/demo")


def demo(config: DemoConfig) -> None:
    """Look at every picture, print what was done, and draw it."""
    check(config.target is None or not config.explore, "target", "none with --explore", config.target)
    check(config.photo is None or config.camera is None, "photo", "none with --camera", config.photo)
    # What can be told of the arguments is told before anything is loaded.
    classes = known_classes(config)
    agent = None if classes is not None else make_agent(config)
    classes = agent.classes[1:] if agent is not None else classes or ()
    if config.target is None and not config.explore:
        print(f"Choose a class with --target, or --explore. {config.models or config.detector} knows:\n")
        print(columns(classes))
        return
    if config.target is not None:
        config = replace(config, target=classes[class_index(config.target, classes, "target") - 1])
    stream = open_live(config)
    watched = opened(pictures(config, classes)) if stream is None else iter(())
    agent = make_agent(config) if agent is None else agent
    if stream is not None:
        given = {name: getattr(config, name) for name in ("rate", "start", "seed", "confirm", "give_up")}
        path = watch(agent.live(config.target, **given), stream, config.out / "live")
        print(f"written:\n  {path}")
        return
    written, pool, episodes = [], Pool(), []
    several = config.photo is not None and config.photo.is_dir()
    zooming = zoom_agent(config, agent)
    for number, picture in enumerate(watched):
        if zooming is not None and zooming.pays(picture.image):
            folder = config.out / f"{number:03d}-{plain_name(picture.name)}" if several else config.out
            written += zoom_in(zooming, picture, config, folder)
            continue
        scanpath = look_at(agent, picture, config)
        print(told(picture.name, scanpath))
        folder = config.out / f"{number:03d}-{plain_name(picture.name)}" if several else config.out
        views = shown(scanpath, config)
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
        return ActivePerception.recommended(config.detector, sigma=sensor["sigma"], growth=sensor["growth"])
    make = ActivePerception.published if config.agent == "published" else ActivePerception.raw
    return make(config.detector, sensor=config.sensor or "published")


def moved(detector: str) -> dict[str, Any]:
    """Where a detector lies now that a folder of models names, if that is told."""
    return {} if detector == DemoConfig().detector else {"detector": detector}


def zoom_agent(config: DemoConfig, agent: ActivePerception) -> ZoomAgent | None:
    """The agent for large pictures, with the same detector; none where no evidence is shipped for it."""
    name = agent.eye.detector.name
    if config.agent != "recommended" or not (GlimpseEvidence.shipped / f"{name}.safetensors").is_file():
        return None
    zooming = ZoomAgent(ZoomEye(agent.eye.detector), GlimpseEvidence.from_pretrained(name))
    return zooming.eval().requires_grad_(False)


def zoom_in(agent: ZoomAgent, picture: Picture, config: DemoConfig, folder: Path) -> list[Path]:
    """Search or explore a picture larger than the detector's input, print where it was looked at, and draw that."""
    passes = 24 if config.shifts is None else config.shifts + 1
    if config.target is None:
        given = {"worth": config.until}
        path = agent.explore(picture.image, passes=passes, **chosen(given))
    else:
        given = {"confirm": config.confirm, "give_up": config.give_up}
        path = agent.search(picture.image, config.target, passes=passes, **chosen(given))
    width, height = path.lattice.size
    print(f"{picture.name}, {width} × {height} px, looked at in windows: {describe_zoom(path)}")
    unused = [name for name in ("sensor", "start", "price", "report") if getattr(config, name) is not None]
    if unused:
        print(f"  not used for a picture of this size: {', '.join(unused)}")
    for number, glance in enumerate(path.glances):
        x, y, magnification = glance.window.fixation
        count = int((glance.detections.confidence >= viz.CONFIDENT).sum())
        where = f"at ({x:.0f}, {y:.0f})" if number else "the whole picture"
        print(f"  {number:2d}  {where} × {magnification:.2f}: {count} detection{'s' if count != 1 else ''}")
    return [viz.save_figure(viz.plot_zoom_path(path, reduced(picture.image).clamp(0, 1)), folder / "zoom.png")]


def chosen(values: dict[str, float | None]) -> dict[str, Any]:
    """Those that were given."""
    return {name: value for name, value in values.items() if value is not None}


def known_classes(config: DemoConfig) -> tuple[str, ...] | None:
    """Classes of the detector, where they are known before it is loaded."""
    return check_detector(config.detector) if config.models is None else Manifest.read(config.models).classes


def open_live(config: DemoConfig) -> Stream | None:
    """The video or the camera that the settings name, if they do."""
    source = config.camera if config.photo is None else config.photo if is_video(config.photo) else None
    if source is None:
        return None
    for name in ("shifts", "price", "until", "report"):
        value = getattr(config, name)
        check(value is None, name, "none for a video or a camera, which ends with its --frames", value)
    return open_stream(source, config.frames)


def pictures(config: DemoConfig, classes: Sequence[str]) -> Iterator[Picture]:
    """The pictures that the settings name."""
    if config.photo is None:
        yield embedded_picture(classes, config.target, config.seed)
    else:
        yield from open_pictures(config.photo)


def opened(pictures: Iterator[Picture]) -> Iterator[Picture]:
    """The same pictures, of which the first is read at once."""
    first = next(pictures)
    return chain([first], pictures)


def look_at(agent: ActivePerception, picture: Picture, config: DemoConfig) -> Scanpath:
    """Search or explore a picture."""
    common: dict[str, Any] = {"start": start_cell(agent, picture, config), "seed": config.seed}
    with torch.inference_mode():
        if config.target is None:
            shifts = 20 if config.shifts is None else config.shifts
            return agent.explore(picture.image, shifts=shifts, until=config.until, **common)
        shifts = 30 if config.shifts is None else config.shifts
        common |= {"confirm": config.confirm, "give_up": config.give_up, "price": config.price}
        return agent.search(picture.image, config.target, shifts=shifts, **common)


def start_cell(agent: ActivePerception, picture: Picture, config: DemoConfig) -> int | None:
    """The first cell: off the target where that is known, else as the agent draws it."""
    if config.start is not None or picture.boxes is None:
        return config.start
    grid = semfov.Grid(agent.columns, agent.rows, (picture.image.shape[-1], picture.image.shape[-2]))
    free = (~grid.footprint(picture.boxes).any(0)).nonzero()[:, 0]
    generator = torch.Generator().manual_seed(config.seed)
    return int(free[torch.randint(len(free), (1,), generator=generator)]) if len(free) else None


def told(name: str, scanpath: Scanpath) -> str:
    """What was done, fixation by fixation, as a table."""
    if scanpath.target is None:
        values, what = viz.entropy(scanpath), "entropy (bits)"
    else:
        values, what = viz.class_posterior(scanpath), f"p({scanpath.classes[scanpath.target]})"
    anywhere = None if scanpath.presence is None else scanpath.presence.tolist()
    head = ["#", "at (column, row)", "seen from there", f"{what} there", "highest", "at"]
    rows = [[*head, *([] if anywhere is None else ["anywhere"]), "ms"]]
    for number, (cell, value) in enumerate(zip(scanpath.cells.tolist(), values, strict=True)):
        best = int(value.argmax())
        milliseconds = 1000 * sum(scanpath.seconds[number].values())
        figures = [f"{float(value[cell]):.3f}", f"{float(value[best]):.3f}", place(scanpath, best)]
        figures += [] if anywhere is None else [f"{anywhere[number]:.3f}"]
        rows.append([str(number), place(scanpath, cell), seen(scanpath, number), *figures, f"{milliseconds:.0f}"])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    if scanpath.target is None:
        lines += ["", "what is where:", *named(scanpath)]
    return "\n".join([f"{name}: {viz.describe(scanpath)}. {viz.why_it_ended(scanpath)}".rstrip(), *lines, ""])


def named(scanpath: Scanpath) -> list[str]:
    """What the map names at the end, a line for each class: in how many cells, how sure at best, and where that is."""
    parts: dict[str, list[int]] = {}
    for label, cells, _ in viz.named_regions(scanpath):
        parts.setdefault(label, []).extend(cells)
    lines = []
    for label, cells in sorted(parts.items(), key=lambda item: -len(item[1])):
        chance = scanpath.probabilities[-1, cells, scanpath.classes.index(label)]
        best = cells[int(chance.argmax())]
        many = f"{len(cells)} cell{'s' if len(cells) != 1 else ''}"
        lines.append(f"  {label}: {many}, p up to {float(chance.max()):.2f} at {place(scanpath, best)}")
    return lines or ["  nothing that is more probable than background"]


def seen(scanpath: Scanpath, fixation: int, most: int = 3) -> str:
    """The most confident detections of a look, in words."""
    detections = scanpath.detections[fixation]
    pairs = zip(detections.labels[0].tolist(), detections.confidence[0].tolist(), strict=True)
    sure = [f"{scanpath.classes[label]} {score:.2f}" for label, score in pairs if score >= viz.CONFIDENT]
    more = f" and {len(sure) - most} more" if len(sure) > most else ""
    return ", ".join(sure[:most]) + more or "nothing"


def place(scanpath: Scanpath, cell: int) -> str:
    """Column and row of a cell, from 0."""
    row, column = divmod(cell, scanpath.grid.columns)
    return f"({column}, {row})"


def shown(scanpath: Scanpath, config: DemoConfig) -> list[Tensor]:
    """What the eye was shown at each fixation, where something that is asked for needs it."""
    needed = config.report is not None or {"views", "animation"} & set(config.draw)
    return scanpath.views() if needed else []


def draw(
    folder: Path, scanpath: Scanpath, picture: Picture, views: list[Tensor], wanted: Sequence[Drawn]
) -> list[Path]:
    """Write those figures of an episode that are wanted, and the animation."""
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


def columns(names: Sequence[str], width: int = 100) -> str:
    """Names in columns, down first."""
    wide = max(map(len, names)) + 2
    across = max(1, width // wide)
    down = -(-len(names) // across)
    return "\n".join("".join(name.ljust(wide) for name in names[row::down]).rstrip() for row in range(down))


def plain_name(name: str) -> str:
    """A name that every file system takes.

    >>> plain_name("my cup, frame 3")
    'my-cup-frame-3'
    """
    return re.sub(r"[^\w.]+", "-", name).strip("-.") or "picture"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    # A flag needs no value.
    given = ["--explore=true" if argument == "--explore" else argument for argument in given]
    return run_command(demo, DemoConfig, __doc__, given, positional=("photo", PHOTO))


if __name__ == "__main__":
    sys.exit(main())
