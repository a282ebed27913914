"""Subcommand app: a page in the browser on which to search a picture, and to look yourself."""

import os
import socket
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from html import escape
from ipaddress import ip_address
from itertools import cycle
from typing import Any, NamedTuple
from urllib.parse import urlsplit

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.agents.fovea_episode import FoveaEpisode, GazePlan
from semfov.belief.grid import Grid
from semfov.cli.agent import detector_classes, make_agent
from semfov.cli.options import AppOptions
from semfov.data import Scene, class_index, read_image
from semfov.data.examples import EXAMPLES, example_scene
from semfov.data.images import PhotographPicture
from semfov.decision.stopping import StoppingCriterion
from semfov.errors import DataError, InputError, SemfovError, check, check_data
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
_VIEWERS = 15  # whose scanpaths the page of a prediction has
_HEIGHT = 820  # pixels of the screen for the page of a record
_MOST_BYTES = 2**26  # of a file that is uploaded
_MOST_PIXELS = 2**25  # of a picture: on this page it is decoded as a whole
_SECONDS = 60.0  # longest time of a search, for which others wait
_LONGEST = 1600  # longer side in pixels of the picture that is clicked on

_PICTURE = "one, or an example"  # what is expected
_CLASS = "one to search for"  # likewise
_CLICK = "Choose a class, and click on the picture to look there."
_STYLE = "footer { display: none !important; } .page iframe { width: 100%; border: 0; border-radius: 8px; }"


def serve(options: AppOptions) -> int:
    """Serve the page until Ctrl-C.

    Args:
        options: the options of the command.

    Returns:
        The exit code.
    """
    os.environ.setdefault("GRADIO_ANALYTICS_ENABLED", "False")  # nothing is sent elsewhere
    try:
        import gradio  # noqa: F401
    except ImportError:
        raise DataError('app: expected Gradio for the page; pip install "semfov[app]"') from None
    try:
        socket.create_server((options.host, options.port or 0)).close()
    except OSError as error:
        address = f"{options.host}:{options.port or 'any'}"
        raise DataError(f"app: cannot be served on {address}: {error.strerror or error}") from None
    detector_classes(options)
    agent = make_agent(options)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["GRADIO_TEMP_DIR"] = folder  # where pictures are while they are looked at
        page = _make_page(agent)
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
    from starlette.middleware import Middleware

    look = gradio.themes.Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])  # fonts of this machine
    page.queue(default_concurrency_limit=1)
    _, address, _ = page.launch(
        server_name=host, server_port=port, prevent_thread_lock=True, share=False, quiet=True,
        show_error=True, css=_STYLE, theme=look, max_file_size=_MOST_BYTES,
        app_kwargs={"middleware": [Middleware(_Doorkeeper, host=host)]},
    )  # fmt: skip
    return str(address)


class _Doorkeeper:
    """A layer of the server that answers requests of its own page alone, under an address that it was given."""

    # Another page in the same browser can send requests here, also under a name of its own for this address.

    def __init__(self, app: Any, host: str) -> None:
        self._app = app
        self._host = host

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        headers = {key.decode("latin-1"): value.decode("latin-1") for key, value in scope.get("headers", ())}
        if scope["type"] == "lifespan" or self.admits(headers.get("host", ""), headers.get("origin")):
            await self._app(scope, receive, send)
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
        else:
            words = b"semfov app: expected the address that the command prints, and its own page\n"
            kind = [(b"content-type", b"text/plain; charset=utf-8")]
            await send({"type": "http.response.start", "status": 403, "headers": kind})
            await send({"type": "http.response.body", "body": words})

    def admits(self, address: str, origin: str | None) -> bool:
        """Whether a request may enter, by the address that it was sent to and the page that it comes from."""
        try:
            name = urlsplit(f"//{address}").hostname or ""
            is_own_page = origin is None or urlsplit(origin).netloc.lower() == address.lower()
        except ValueError:
            return False
        if not is_own_page:
            return False
        if name in ("localhost", self._host.lower()):
            return True
        try:
            number = ip_address(name)
        except ValueError:
            return self._everywhere and name == socket.gethostname().lower()
        return number.is_loopback or self._everywhere

    @property
    def _everywhere(self) -> bool:
        """Whether the page is served under all addresses of this machine."""
        return self._host in ("0.0.0.0", "::")


def _look_at_cells(agent: ActivePerception, image: Tensor, target: str, cells: Sequence[int]) -> "_OwnLooks":
    """Look at given cells of a picture `(3, H, W)` one after the other, in a search for a target."""
    plan = GazePlan(agent.fovea, class_index(target, agent.classes[1:], "target"), cells=cells)
    with torch.inference_mode():
        like = agent.eye.sensor.like
        episode = FoveaEpisode(plan, image[None].to(like), criterion=lambda grid: StoppingCriterion())
        while episode.look() is not None:
            pass
        of_agent = agent.search(image, target, how="fovea", start=cells[0], shifts=len(cells) - 1, closer=0)
    record = episode.record()
    values = record.values[-1].index_fill(0, record.cells, -torch.inf)
    return _OwnLooks(record, int(values.argmax()), of_agent)


class _Calls:
    """What the page calls; refusals are shown on it."""

    def __init__(self, agent: ActivePerception) -> None:
        self.agent = agent
        self.classes = list(agent.classes[1:])
        self.examples: list[Scene] = []
        with suppress(InputError):  # the detector knows none of their classes
            scenes = [example_scene(name, self.classes) for name in EXAMPLES]
            self.examples = [scene for scene in scenes if len(scene.labels)]
        self._turns = cycle(self.examples)
        self._stops: dict[str, threading.Event] = {}

    def take(self) -> tuple[Image.Image, str]:
        """Take the next example, and the class of most of its objects."""
        scene = next(self._turns)
        return pillow(scene.image), self.classes[int(scene.labels.mode().values) - 1]

    def look(
        self, path: str | None, target: str, task: str, passes: float, prior: float | None = None, visitor: str = ""
    ) -> tuple[str, str]:
        """Look at a picture; `stop` of the same visitor ends it.

        Args:
            path: file of the picture.
            target: class, or all of them.
            task: one of `_TASKS`.
            passes: largest number of passes of the detector.
            prior: for a search, share of such pictures that hold the class; None as in the fit.
            visitor: who asks.

        Returns:
            Words about the record, and its page in a frame.
        """
        with _errors_on_page():
            picture = _read(path)
            check(task != "search" or target in self.classes, "class", _CLASS, target)
            if task == "gaze":
                prediction = self.agent.gaze(picture)
                part = gaze_part(prediction, prediction.scanpaths(_VIEWERS))
                return prediction.describe(), _framed(gaze_page_html("Where people look", [part]))
            stop = self._stops[visitor] = threading.Event()

            def go_on(_: Record) -> bool:
                return not stop.is_set()

            limits: dict[str, Any] = {"passes": int(passes), "seconds": _SECONDS, "on_look": go_on}
            if task == "search":
                limits["prior"] = prior
            record = self._record(picture, target, task, limits)
            data = record.page_data(picture if record.kind.fine else None)
            return record.summary(), _framed(page_html(record.describe(), [data]))

    def _record(self, picture: Tensor, target: str, task: str, options: Mapping[str, Any]) -> Record:
        """Search a picture, find all objects in it or explore it."""
        if task == "search":
            return self.agent.search(picture, target, **options)
        if task == "find all":
            return self.agent.find_all(picture, None if target == _EVERY else target, **options)
        return self.agent.explore(picture, **options)

    def stop(self, visitor: str = "") -> None:
        """End a visitor's search after the look that it is at; what was found is shown."""
        if visitor in self._stops:
            self._stops[visitor].set()

    def click(self, path: str | None, target: str, cells: list[int], event: Any) -> tuple[Any, ...]:
        """Add the cell of a click, and draw what they show."""
        with _errors_on_page():
            image = _read(path)
            check(target in self.classes, "class", _CLASS, target)
            scale = image.shape[-1] / _reduced(image).width
            point = torch.tensor([[side * scale for side in event.index]])
            grid = Grid(self.agent.columns, self.agent.rows, (image.shape[-1], image.shape[-2]))
            cells = [*cells, int(grid.cell_of(point)[0])]
            looks = _look_at_cells(self.agent, image, target, cells)
            view = render([plot_foveated_strip(looks.record, most=1)], dpi=250)[0]
            belief = render([plot_belief(looks.record, -1)], dpi=110)[0]
            return cells, _with_looks(image, looks), view, belief, looks.describe()

    def fresh(self, path: str | None) -> tuple[Any, ...]:
        """No cells, and the picture to click on."""
        with _errors_on_page():
            return [], None if path is None else _reduced(_read(path)), None, None, _CLICK


def _framed(page: str) -> str:
    """Put a page into a frame that shares nothing with the page around it."""
    attributes = f'sandbox="allow-scripts" srcdoc="{escape(page)}" height="{_HEIGHT}"'
    return f'<iframe title="The looks" {attributes}></iframe>'


def _with_looks(image: Tensor, looks: "_OwnLooks") -> Image.Image:
    """Draw the numbered looks of a person, and a ring where the agent would look next."""
    picture = _reduced(image)
    draw = ImageDraw.Draw(picture)
    scale = picture.width / image.shape[-1]
    radius = max(picture.size) / 50
    points = [(x * scale, y * scale) for x, y in looks.record.fixations.tolist()]
    draw.line(points, fill="white", width=5)
    draw.line(points, fill=GAZE, width=3)
    for number, (x, y) in enumerate(points, 1):
        draw.circle((x, y), radius, fill=GAZE, outline="white", width=2)
        draw.text((x, y), str(number), fill="white", anchor="mm", font_size=1.2 * radius)
    x, y = (side * scale for side in looks.point)
    draw.circle((x, y), radius, outline="white", width=6)
    draw.circle((x, y), radius, outline=TARGET, width=4)
    return picture


def _read(path: str | None) -> Tensor:
    """Read the picture in a file that was uploaded, `(3, H, W)`; one that a page should not wait for is refused."""
    check(path is not None, "picture", _PICTURE, "none")
    assert path is not None
    width, height = PhotographPicture(path).size
    got = f"{width} × {height}; reduce it, or give it to semfov find"
    check_data(width * height <= _MOST_PIXELS, "picture", f"at most {_MOST_PIXELS:,} pixels", got)
    return read_image(path)


@contextmanager
def _errors_on_page() -> Iterator[None]:
    """Show an error of the library on the page."""
    import gradio

    try:
        yield
    except SemfovError as error:
        raise gradio.Error(str(error), print_exception=False) from None


def _make_page(agent: ActivePerception) -> Any:
    """Make the page, a `gradio.Blocks`; pictures that it is given are removed within minutes."""
    import gradio

    calls = _Calls(agent)

    def look(
        path: Any, target: str, task: str, passes: float, prior: float | None, request: gradio.Request
    ) -> tuple[str, str]:
        return calls.look(path, target, task, passes, prior, request.session_hash)

    def stop(request: gradio.Request) -> None:
        calls.stop(request.session_hash)

    def click(path: Any, target: str, cells: list[int], event: gradio.SelectData) -> tuple[Any, ...]:
        return calls.click(path, target, cells, event)

    # Gradio knows them by their annotations, which are texts here.
    look.__annotations__["request"] = stop.__annotations__["request"] = gradio.Request
    click.__annotations__["event"] = gradio.SelectData
    fixed: dict[str, Any] = {"interactive": False, "format": "jpeg", "buttons": ["fullscreen", "download"]}
    with gradio.Blocks(title="semfov", analytics_enabled=False, delete_cache=(60, 300), fill_width=True) as page:
        gradio.Markdown("# semfov\nWhere does it look, what does it see there, and what does it believe?")
        with gradio.Row():
            with gradio.Column(scale=1, min_width=300):
                sources = ["upload", "clipboard"]
                picture = gradio.Image(
                    label="Picture", type="filepath", format="png", sources=sources, height=300, buttons=["fullscreen"]
                )
                # Gradio would open the file with any of Pillow's decoders, of which some start programs.
                picture.preprocess = lambda payload: payload and payload.path
                example = gradio.Button("Take an example", visible=bool(calls.examples))
                target = gradio.Dropdown([_EVERY, *calls.classes], value=_EVERY, label="Class", filterable=True)
                task = gradio.Radio(list(_TASKS), value=_TASKS[0], label="What to do")
                passes = gradio.Slider(1, 64, value=16, step=1, label="Passes of the detector at most")
                prior = gradio.Number(
                    label="Of your pictures, what share holds the class?", info="For a search. Empty: as in the fit."
                )
                go = gradio.Button("Look", variant="primary")
                end = gradio.Button("Stop")
            with gradio.Column(scale=2, min_width=300), gradio.Tabs():
                with gradio.Tab("Its looks"):
                    words = gradio.Markdown("Give it a picture or take an example, and press *Look*.")
                    shown = gradio.HTML(elem_classes="page")
                with gradio.Tab("Look yourself"):
                    about = gradio.Markdown(_CLICK)
                    again = gradio.Button("Start again")
                    cells = gradio.State([])
                    looks = gradio.Image(label="Your looks", type="pil", elem_id="own", **fixed)
                    with gradio.Row():
                        view = gradio.Image(label="What the fovea sees there", **fixed)
                        belief = gradio.Image(label="What is believed", **fixed)
        outputs = [cells, looks, view, belief, about]
        example.click(calls.take, [], [picture, target], api_visibility="private")
        go.click(look, [picture, target, task, passes, prior], [words, shown], api_visibility="private")
        end.click(stop, [], [], api_visibility="private", queue=False)
        for changed in (picture.change, again.click, target.change):
            changed(calls.fresh, [picture], outputs, api_visibility="private")
        looks.select(click, [picture, target, cells], outputs, api_visibility="private")
    return page


def _reduced(image: Tensor) -> Image.Image:
    """Reduce the picture that is clicked on."""
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
        """Say what the last look showed, what the belief is, and what the agent did, in lines of Markdown."""
        record = self.record
        detections = detections_in_words(record.looks[-1].detections, record.classes)
        assert record.presence is not None
        chances = record.presence.tolist()
        x, y = self.point
        before = f", {chances[-2]:.2f} before it" if len(chances) > 1 else ""
        lines = [
            f"**Look {len(record)}** shows {detections}.",
            f"The probability that the picture holds “{record.target_name}” is {chances[-1]:.2f} after it{before}.",
            f"The agent would look next at ({x:.0f}, {y:.0f}): the orange ring.",
            f"The agent itself, from your first look and in as many looks: {self.agent.describe()}.",
        ]
        return "\n\n".join(lines)
