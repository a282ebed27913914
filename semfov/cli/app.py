"""Subcommand app: a page in the browser on which to search a picture, and to look yourself."""

import os
import socket
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from html import escape
from itertools import cycle
from typing import Any, NamedTuple

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.agents.fovea import FoveaEpisode
from semfov.belief.grid import Grid
from semfov.cli.agent import detector_classes, make_agent
from semfov.cli.options import AppOptions
from semfov.data import EmbeddedScenes, as_image, class_index
from semfov.errors import DataError, InputError, SemfovError, check
from semfov.paths import Record, Scanpath
from semfov.paths.look import detections_in_words
from semfov.report.episode import pillow
from semfov.report.gaze import gaze_page_html, gaze_part
from semfov.report.page import page_html
from semfov.viz import plot_belief, plot_foveated_strip
from semfov.viz.animation import render
from semfov.viz.style import GAZE, TARGET

_TASKS = ("search", "find all", "explore", "gaze")
_EVERY = "all classes"
_EXAMPLES = 16  # embedded scenes
_VIEWERS = 15  # whose scanpaths the page of a prediction has
_HEIGHT = 820  # pixels of the screen for the page of a record
_LONGEST = 1600  # longer side in pixels of the picture that is clicked on

_PICTURE, _CLASS = "one, or an example", "one to search for"  # what is expected
_CLICK = "Choose a class, and click on the picture to look there."
_STYLE = "footer { display: none !important; } .page iframe { width: 100%; border: 0; border-radius: 8px; }"


def serve(options: AppOptions) -> int:
    """Serve the page until Ctrl-C."""
    os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")  # nothing is sent elsewhere
    try:
        import gradio  # noqa: F401
    except ImportError:
        raise DataError('app: expected Gradio for the page; pip install "semfov[app]"') from None
    try:
        socket.create_server((options.host, options.port or 0)).close()
    except OSError as error:
        where = f"{options.host}:{options.port or 'any'}"
        raise DataError(f"app: cannot be served on {where}: {error.strerror or error}") from None
    detector_classes(options)
    agent = make_agent(options)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["GRADIO_TEMP_DIR"] = folder  # where pictures are while they are looked at
        page = _make_page(agent, options.seed)
        address = _launched(page, options.host, options.port)
        print(f"{agent.eye.detector.settings()['name']}: open {address} in a browser; Ctrl-C ends it", flush=True)
        try:
            threading.Event().wait()
        finally:
            page.close()
    return 0


def _launched(page: Any, host: str, port: int | None) -> str:
    """Serve a page, with one look at a time; returns its address."""
    import gradio

    look = gradio.themes.Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])  # fonts of this machine
    page.queue(default_concurrency_limit=1)
    _, address, _ = page.launch(
        server_name=host, server_port=port, prevent_thread_lock=True, share=False, quiet=True,
        show_error=True, css=_STYLE, theme=look,
    )  # fmt: skip
    return str(address)


def _look_at_cells(agent: ActivePerception, image: Tensor, target: str, cells: Sequence[int]) -> "_OwnLooks":
    """Look at given cells of a picture `(3, H, W)` one after the other, in a search for a target."""
    episode = FoveaEpisode(agent.fovea, class_index(target, agent.classes[1:], "target"), closer=0, cells=cells)
    with torch.inference_mode():
        episode.open(image[None].to(agent.eye.sensor.like))
        while episode.look() is not None:
            pass
        own = agent.search(image, target, how="fovea", start=cells[0], shifts=len(cells) - 1, closer=0)
    record = episode.record()
    left = record.values[-1].index_fill(0, record.cells, -torch.inf)
    return _OwnLooks(record, int(left.argmax()), own)


class _Calls:
    """What the page calls; refusals are shown on it."""

    def __init__(self, agent: ActivePerception, seed: int) -> None:
        self.agent, self.classes = agent, list(agent.classes[1:])
        self.scenes: EmbeddedScenes | None = None
        with suppress(InputError):  # the detector knows none of their classes
            self.scenes = EmbeddedScenes(self.classes, count=_EXAMPLES, seed=seed)
        self._numbers = cycle(range(_EXAMPLES))

    def take(self) -> tuple[Image.Image, str]:
        """The next embedded scene, and a class that it holds."""
        assert self.scenes is not None
        index = next(self._numbers)
        return pillow(self.scenes[index].image), self.scenes.classes[self.scenes.targets(index)[0] - 1]

    def look(self, picture: Any, target: str, task: str, passes: float) -> tuple[str, str]:
        """Words about a record of the picture, and its page in a frame."""
        with _told():
            agent, passes = self.agent, int(passes)
            check(picture is not None, "picture", _PICTURE, "none")
            check(task != "search" or target in self.classes, "class", _CLASS, target)
            if task == "gaze":
                prediction = agent.gaze(picture)
                part = gaze_part(prediction, prediction.scanpaths(_VIEWERS))
                words, page = prediction.describe(), gaze_page_html("Where people look", [part])
            else:
                if task == "search":
                    record = agent.search(picture, target, passes=passes)
                elif task == "find all":
                    record = agent.find_all(picture, None if target == _EVERY else target, passes=passes)
                else:
                    record = agent.explore(picture, passes=passes)
                data = record.page_data(picture if record.how == "windows" else None)
                words, page = record.summary(), page_html(record.describe(), [data])
            # A frame that shares nothing with the page around it.
            source = f'sandbox="allow-scripts" srcdoc="{escape(page)}" height="{_HEIGHT}"'
            return words, f'<iframe title="The looks" {source}></iframe>'

    def click(self, picture: Any, target: str, cells: list[int], event: Any) -> tuple[Any, ...]:
        """The cells with that of the click, and what they show."""
        with _told():
            check(picture is not None, "picture", _PICTURE, "none")
            check(target in self.classes, "class", _CLASS, target)
            image = as_image(picture, argument="picture")
            scale = image.shape[-1] / _reduced(image).width
            point = torch.tensor([[side * scale for side in event.index]])
            grid = Grid(self.agent.columns, self.agent.rows, (image.shape[-1], image.shape[-2]))
            cells = [*cells, int(grid.cell_of(point)[0])]
            looked = _look_at_cells(self.agent, image, target, cells)
            seen = render([plot_foveated_strip(looked.record, most=1)], dpi=250)[0]
            believed = render([plot_belief(looked.record, -1)], dpi=110)[0]
            # Numbered looks, and a ring where the agent would look next.
            drawn = _reduced(image)
            draw, scale = ImageDraw.Draw(drawn), drawn.width / image.shape[-1]
            radius = max(drawn.size) / 50
            points = [(x * scale, y * scale) for x, y in looked.record.fixations.tolist()]
            draw.line(points, fill="white", width=5)
            draw.line(points, fill=GAZE, width=3)
            for number, (x, y) in enumerate(points, 1):
                draw.circle((x, y), radius, fill=GAZE, outline="white", width=2)
                draw.text((x, y), str(number), fill="white", anchor="mm", font_size=1.2 * radius)
            x, y = (side * scale for side in looked.point)
            draw.circle((x, y), radius, outline="white", width=6)
            draw.circle((x, y), radius, outline=TARGET, width=4)
            return cells, drawn, seen, believed, looked.describe()

    def fresh(self, picture: Any) -> tuple[Any, ...]:
        """No cells, and the picture to click on."""
        with _told():
            shown = None if picture is None else _reduced(as_image(picture, argument="picture"))
            return [], shown, None, None, _CLICK


@contextmanager
def _told() -> Iterator[None]:
    """Show an error of the library on the page."""
    import gradio

    try:
        yield
    except SemfovError as error:
        raise gradio.Error(str(error), print_exception=False) from None


def _make_page(agent: ActivePerception, seed: int = 0) -> Any:
    """The page, a `gradio.Blocks`; pictures that it is given are removed within minutes."""
    import gradio

    calls = _Calls(agent, seed)

    def click(picture: Any, target: str, cells: list[int], event: gradio.SelectData) -> tuple[Any, ...]:
        return calls.click(picture, target, cells, event)

    click.__annotations__["event"] = gradio.SelectData  # by which Gradio knows it
    fixed: dict[str, Any] = {"interactive": False, "format": "jpeg", "buttons": ["fullscreen", "download"]}
    with gradio.Blocks(title="semfov", analytics_enabled=False, delete_cache=(60, 300), fill_width=True) as page:
        gradio.Markdown("# semfov\nWhere does it look, what does it see there, and what does it believe?")
        with gradio.Row():
            with gradio.Column(scale=1, min_width=300):
                sources = ["upload", "clipboard"]
                picture = gradio.Image(label="Picture", type="pil", sources=sources, height=300, buttons=["fullscreen"])
                example = gradio.Button("Take an example", visible=calls.scenes is not None)
                target = gradio.Dropdown([_EVERY, *calls.classes], value=_EVERY, label="Class", filterable=True)
                task = gradio.Radio(list(_TASKS), value=_TASKS[0], label="What to do")
                passes = gradio.Slider(1, 64, value=16, step=1, label="Passes of the detector at most")
                go = gradio.Button("Look", variant="primary")
            with gradio.Column(scale=2, min_width=300), gradio.Tabs():
                with gradio.Tab("Its looks"):
                    words = gradio.Markdown("Give it a picture or take an example, and press *Look*.")
                    shown = gradio.HTML(elem_classes="page")
                with gradio.Tab("Look yourself"):
                    about = gradio.Markdown(_CLICK)
                    again = gradio.Button("Start again")
                    cells = gradio.State([])
                    own = gradio.Image(label="Your looks", type="pil", elem_id="own", **fixed)
                    with gradio.Row():
                        seen = gradio.Image(label="What the fovea sees there", **fixed)
                        believed = gradio.Image(label="What is believed", **fixed)
        outputs = [cells, own, seen, believed, about]
        example.click(calls.take, [], [picture, target], api_visibility="private")
        go.click(calls.look, [picture, target, task, passes], [words, shown], api_visibility="private")
        for changed in (picture.change, again.click, target.change):
            changed(calls.fresh, [picture], outputs, api_visibility="private")
        own.select(click, [picture, target, cells], outputs, api_visibility="private")
    return page


def _reduced(image: Tensor) -> Image.Image:
    """The picture that is clicked on."""
    picture = pillow(image)
    picture.thumbnail((_LONGEST, _LONGEST))
    return picture


class _OwnLooks(NamedTuple):
    """The looks of a person, the cell that the agent would look at next, and its own looks from the same start."""

    record: Scanpath
    advice: int
    agent: Record

    @property
    def point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, where the agent would look next."""
        x, y = self.record.grid.centres[self.advice].tolist()
        return x, y

    def describe(self) -> str:
        """What the last look showed, what the belief is, and what the agent did, in lines of Markdown."""
        record, target = self.record, self.record.target_name
        seen = detections_in_words(record.looks[-1].detections, record.classes)
        assert record.presence is not None
        chances, (x, y) = record.presence.tolist(), self.point
        before = f", {chances[-2]:.2f} before it" if len(chances) > 1 else ""
        lines = [
            f"**Look {len(record)}** shows {seen}.",
            f"The probability that the picture holds “{target}” is {chances[-1]:.2f} after it{before}.",
            f"The agent would look next at ({x:.0f}, {y:.0f}): the orange ring.",
            f"The agent itself, from your first look and in as many looks: {self.agent.describe()}.",
        ]
        return "\n\n".join(lines)
