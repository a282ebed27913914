"""Subcommand demo: a page with a search, a find, gaze and a stream on the photographs that come with semfov."""

import sys
from collections.abc import Callable
from time import perf_counter

import torch
from PIL import Image
from tqdm import tqdm

from semfov.agent import ActivePerception
from semfov.cli.options import DemoOptions
from semfov.cli.results import held_outputs
from semfov.data.examples import example, example_scene
from semfov.io.files import check_writable
from semfov.paths import Record
from semfov.report.demo import DemoPart, demo_page_html, film_html, picture_html
from semfov.report.episode import jpeg_uri, pillow
from semfov.report.template import page_path, write_html
from semfov.report.zoom import zoom_data
from semfov.viz.animation import render
from semfov.viz.live import draw_moment
from semfov.viz.opening import opening_frames

_TITLE = "semfov: four tasks on photographs that come with it"
_WIDTH = 720  # pixels of a picture or a film
_SECONDS_A_LOOK = 0.9  # of a film of looks
_SECONDS_A_FRAME = 0.5  # of the film of the stream

_FRAMES = 16  # of the stream
_CAMERA = (640, 420)  # width and height of a frame in pixels
_DRAWN = (480, 315)  # likewise of its drawing, in which a line is written that is to be read on a phone, too
_FIRST, _LAST = (40, 40), (850, 40)  # left upper corners of the first and the last frame on the sheet


def make_demo(options: DemoOptions) -> int:
    """Do each task on a photograph that comes with semfov, and write a page of the results.

    Args:
        options: the options of the command.

    Returns:
        The exit code.
    """
    out = page_path(options.out, "out")
    check_writable(out)
    began = perf_counter()
    parts = []
    hidden = options.quiet or not sys.stderr.isatty()
    with held_outputs(options):
        with tqdm(total=len(_TASKS) + 1, desc="detector", unit="part", leave=False, disable=hidden) as bar:
            agent = ActivePerception.recommended()
            bar.update()
            for name, show_task in _TASKS.items():
                bar.set_description(name)
                parts.append(show_task(agent))
                bar.update()
        introduction = (
            f"All of this was computed on this machine by {agent.eye.detector.name}, the detector that comes with "
            "semfov, in photographs of Flickr Commons. Nothing was downloaded."
        )
        write_html(out, demo_page_html(_TITLE, introduction, parts))
    size = out.stat().st_size / 1e6
    seconds = perf_counter() - began
    print(f"wrote {out} ({size:.1f} MB, {', '.join(_TASKS)}) in {seconds:.1f} s; open it in a browser")
    return 0


def _show_search(agent: ActivePerception) -> DemoPart:
    """Search the photograph of a beach for a dog."""
    beach = example("beach")
    records: list[Record] = []
    found = agent.search(beach, "dog", on_look=records.append)
    captions = [f"dog: {record.verdict or 'undecided'}" for record in records]
    frames = opening_frames(records, pillow(beach), agent.eye.detector.input_size, captions, _WIDTH)
    return DemoPart(
        heading="Search: is there a dog, and where?",
        picture=film_html(frames, _SECONDS_A_LOOK, found.describe()),
        result=f"{found.describe()}. {found.why_it_ended()}",
        command="semfov search kitchen.jpg --target cup --report cup.html",
        episode=zoom_data(found, beach, name="beach"),
    )


def _show_find(agent: ActivePerception) -> DemoPart:
    """Find the people on a sheet of five photographs."""
    scene = example_scene("sheet", agent.classes[1:])
    records: list[Record] = []
    found = agent.find_all(scene.image, "person", on_look=records.append)
    captions = [record.words.objects.partition(";")[0] for record in records]
    frames = opening_frames(records, pillow(scene.image), agent.eye.detector.input_size, captions, _WIDTH)
    marked = int((scene.labels == agent.classes.index("person")).sum())
    return DemoPart(
        heading="Find: all people on a sheet of five photographs",
        picture=film_html(frames, _SECONDS_A_LOOK, found.describe()),
        result=f"{found.describe()}. {marked} are marked by hand. Each window is as sharp as the detector sees it.",
        command="semfov find harbour.jpg --target person --report people.html",
        episode=zoom_data(found, scene.image, name="sheet"),
    )


def _show_gaze(agent: ActivePerception) -> DemoPart:
    """Predict where people look in the photograph of a beach."""
    prediction = agent.gaze(example("beach"))
    result = (
        "Half of all fixations are inside the thick line, 90 % inside the thin one. 1 to 3 are the first fixations."
    )
    figure = prediction.plot()
    # The page says beside the picture what the title says.
    (axes,) = figure.axes
    axes.set_title("")
    axes.set_axis_off()
    width, height = prediction.size
    figure.set_layout_engine("none")
    figure.set_size_inches(6.4, 6.4 * height / width)
    axes.set_position((0, 0, 1, 1))
    drawing = torch.from_numpy(render([figure], dpi=115)[0]).permute(2, 0, 1)
    return DemoPart(
        heading="Gaze: where do people look on the beach?",
        picture=picture_html(jpeg_uri(drawing, _WIDTH, 85), result),
        result=result,
        command="semfov gaze poster.jpg --report poster.html",
    )


def _show_stream(agent: ActivePerception) -> DemoPart:
    """Look for people with a camera that moves over the sheet."""
    sheet = example("sheet")
    width, height = _CAMERA
    live = agent.live(["person"])
    frames = []
    most = 0
    for number in range(_FRAMES):
        share = number / (_FRAMES - 1)
        left, top = (round(first + share * (last - first)) for first, last in zip(_FIRST, _LAST, strict=True))
        frame = sheet[:, top : top + height, left : left + width]
        # Where this camera is, is known; to estimate it from the frames would take OpenCV.
        pose = [[1.0, 0.0, float(_FIRST[0] - left)], [0.0, 1.0, float(_FIRST[1] - top)]]
        moment = live.step(frame, pose=pose)
        drawing = draw_moment(frame, moment, f"frame {number + 1}: {moment.describe()}", _DRAWN)
        frames.append(Image.fromarray(drawing))
        most = max(most, len(moment.objects))
    result = (
        f"One look at each of {_FRAMES} frames of a camera that moves over the sheet; what was found is carried along. "
        f"At most {most} people are found in a frame."
    )
    return DemoPart(
        heading="Stream: people before a moving camera",
        picture=film_html(frames, _SECONDS_A_FRAME, result),
        result=result,
        command="semfov live --camera 0 --find person",
    )


_TASKS: dict[str, Callable[[ActivePerception], DemoPart]] = {
    "search": _show_search,
    "find": _show_find,
    "gaze": _show_gaze,
    "stream": _show_stream,
}
"""What shows each task, by its name, in the order of the page."""
