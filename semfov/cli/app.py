"""Subcommand app: a page in the browser on which to search a picture, and to look yourself."""

import os
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from PIL import Image
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.belief.grid import Grid
from semfov.belief.prior import PriorLike
from semfov.cli.agent import detector_classes, make_agent
from semfov.cli.doorkeeper import Doorkeeper, token_for
from semfov.cli.options import AppOptions
from semfov.cli.own_looks import SCRIPT, STYLE, TEMPLATE, look_at_cells, scene_json
from semfov.cli.request_limits import RequestLimits
from semfov.data import Scene, read_image
from semfov.data.examples import EXAMPLES, example_scene
from semfov.data.images import PhotographPicture
from semfov.errors import DataError, InputError, SemfovError, check, check_data
from semfov.paths import Record
from semfov.report.episode import pillow
from semfov.report.gaze import gaze_page_html, gaze_part
from semfov.report.page import page_html

if TYPE_CHECKING:
    import gradio


class _Task(NamedTuple):
    """What a person can ask for, and the fields that it uses."""

    by_class: bool = False
    by_passes: bool = True
    by_prior: bool = False


_TASKS = {
    "find all": _Task(by_class=True),
    "search": _Task(by_class=True, by_prior=True),
    "explore": _Task(),
    "gaze": _Task(by_passes=False),
}
_EVERY = "all classes"
_VIEWERS = 15  # whose scanpaths the page of a prediction has
_MOST_BYTES = 2**26  # of a file that is uploaded
_MOST_PIXELS = 2**25  # of a picture: on this page it is decoded as a whole
_SECONDS = 60.0  # longest time of a search, for which others wait
_FARTHEST = 2**31  # pixels of a point from the picture's corner
_MOST_WAITING = 64  # requests in the queue; further ones are refused
_SECONDS_KEPT = 3600  # of a picture that was given; a person may read for long before the next look
_SECONDS_SWEPT = 600  # after which those that are older are removed, again and again

_PICTURE = "one, or an example"  # what is expected
_READY = "Press *Look*, or give it a picture of your own."
_NO_PICTURE = "Give it a picture, or take an example."
_WHAT = "Choose what to do."
_WHICH = "Choose a class: a search looks for one."
_CLICK = "Point at the picture to see as the fovea does. Click to look: find “{}” in fewer looks than the agent."
_WHICH_OWN = "Choose a class in the field *Class*, and look for it here."
_STYLE = """
footer { display: none !important; }
.main.fillable { padding-top: 8px !important; }
:is(.page, #own) .html-container { padding: 0 !important; }
.title .prose { display: flex; gap: 1rem; align-items: baseline; }
.title :is(h1, p) { margin: 0; }
.page iframe { width: 100%; height: max(30rem, calc(100vh - 8.5rem)); border: 0; border-radius: 8px; }
#task .wrap { flex-wrap: nowrap; gap: 4px; }
#task label { padding: 6px 8px; white-space: nowrap; }
#task label:focus-within { outline: 2px solid var(--primary-600); }
#press { flex-wrap: nowrap; align-items: stretch; gap: 8px; }
#press .primary { background: var(--primary-600); }
body:not(.dark) [role="tab"].selected { color: var(--primary-700) !important; }
@media (max-width: 640px) {
  .main.fillable { padding: 8px !important; }
  .main.fillable :is(.row, .column) { gap: 8px; }
  .tabitem { padding-top: 4px !important; }
  .title h1 { font-size: 1.2rem !important; }
  .title p, #picture .source-selection { display: none; }
  #picture, #picture .image-container { height: 120px !important; min-height: 0 !important; }
  #task label { flex: 1; justify-content: center; padding: 6px 2px; }
  #task input { position: absolute; opacity: 0; }
  #task label span { margin: 0; }
  #task label.selected { background: var(--primary-600); color: white; }
  .page iframe { height: max(30rem, calc(100vh - 2rem)); }
}
"""


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
        # Tried out now, as the detector takes seconds to load.
        socket.create_server((options.host, options.port or 0)).close()
    except OSError as error:
        address = f"{options.host}:{options.port or 'any'}"
        raise DataError(f"app: cannot be served on {address}: {error.strerror or error}") from None
    detector_classes(options)
    agent = make_agent(options)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["GRADIO_TEMP_DIR"] = folder  # where pictures are while they are looked at
        page = _make_page(agent)
        address = _launched(page, Path(folder), options.host, options.port, token_for(options.host))
        others = "; elsewhere with this machine's address in place of localhost" if "//localhost" in address else ""
        name = agent.eye.detector.settings()["name"]
        print(f"{name}: open {address} in a browser{others}; Ctrl-C ends it", flush=True)
        try:
            threading.Event().wait()
        finally:
            page.close()
    return 0


def _launched(page: "gradio.Blocks", folder: Path, host: str, port: int | None, token: str | None = None) -> str:
    """Serve a page whose pictures are kept in a folder; returns its address, with the token that it asks for."""
    import gradio
    from starlette.middleware import Middleware

    look = gradio.themes.Base(font=["system-ui", "sans-serif"], font_mono=["monospace"])  # fonts of this machine
    page.queue(default_concurrency_limit=1, max_size=_MOST_WAITING, api_open=False)
    _, address, _ = page.launch(
        server_name=host, server_port=port, prevent_thread_lock=True, share=False, quiet=True,
        show_error=True, head=f"<style>{_STYLE}</style>", theme=look, max_file_size=_MOST_BYTES,
        app_kwargs={
            "middleware": [
                Middleware(Doorkeeper, host=host, token=token),
                Middleware(RequestLimits, folder=folder, most_bytes=_MOST_BYTES, seconds_kept=_SECONDS_KEPT),
            ]
        },
    )  # fmt: skip
    return str(address) if token is None else f"{address}?token={token}"


class _Calls:
    """What the page calls; refusals are shown on it."""

    def __init__(self, agent: ActivePerception) -> None:
        self.agent = agent
        self.classes = list(agent.classes[1:])
        self.examples: list[Scene] = []
        with suppress(InputError):  # the detector knows none of their classes
            scenes = [example_scene(name, self.classes) for name in EXAMPLES]
            self.examples = [scene for scene in scenes if len(scene.labels)]
        self._stops: dict[str, threading.Event] = {}

    def take(self, number: int, task: str) -> tuple[Image.Image | None, str, str, int]:
        """Take an example.

        Args:
            number: its number, counted on beyond the last one.
            task: what it is for.

        Returns:
            The picture, the class for the task, the class of most objects in it, and the number of the next example.
        """
        if not self.examples:
            return None, _EVERY, "", 0
        scene = self.examples[number % len(self.examples)]
        usual = self.classes[int(scene.labels.mode().values) - 1]
        return pillow(scene.image), usual if task == "search" else _EVERY, usual, number + 1

    def look(
        self,
        path: str | None,
        target: str,
        task: str,
        passes: float,
        prior: str = "",
        visitor: str = "",
    ) -> tuple[str, str]:
        """Look at a picture; `stop` of the same visitor ends it.

        Args:
            path: file of the picture.
            target: class, or all of them.
            task: one of `_TASKS`.
            passes: largest number of passes of the detector.
            prior: for a search, share of such pictures that hold the class, or `fit`; empty for one half.
            visitor: who asks.

        Returns:
            What is asked for before a look, if anything, and the page of the record in a frame.
        """
        if path is None:
            return _NO_PICTURE, ""
        if task not in _TASKS:
            return _WHAT, ""
        if task == "search" and target not in self.classes:
            return _WHICH, ""
        with _errors_on_page():
            picture = _read(path)
            if task == "gaze":
                return "", _framed(self._gaze_page(picture))
            with self._stoppable(visitor) as go_on:
                limits = {"passes": int(passes), "seconds": _SECONDS, "on_look": go_on}
                record = self._record(picture, target, task, prior, limits)
            return "", _framed(_record_page(record, picture))

    @contextmanager
    def _stoppable(self, visitor: str) -> Iterator[Callable[[Record], bool]]:
        """Open a block in which `stop` of a visitor ends a search; yields what tells after each look to go on."""
        stop = threading.Event()
        self._stops[visitor] = stop

        def go_on(_: Record) -> bool:
            return not stop.is_set()

        try:
            yield go_on
        finally:
            self._stops.pop(visitor, None)

    def _record(self, picture: Tensor, target: str, task: str, prior: str, limits: Mapping[str, Any]) -> Record:
        """Search a picture, find all objects in it or explore it."""
        if task == "search":
            return self.agent.search(picture, target, prior=_share(prior), **limits)
        if task == "find all":
            return self.agent.find_all(picture, None if target == _EVERY else target, **limits)
        return self.agent.explore(picture, **limits)

    def _gaze_page(self, picture: Tensor) -> str:
        """Make the page of where people look in a picture."""
        prediction = self.agent.gaze(picture)
        part = gaze_part(prediction, prediction.scanpaths(_VIEWERS))
        return gaze_page_html("Where people look", [part])

    def stop(self, visitor: str = "") -> None:
        """End a visitor's search after the look that it is at; what was found is shown."""
        if visitor in self._stops:
            self._stops[visitor].set()

    def sought(self, target: str, usual: str) -> str:
        """Choose the class that a person looks for: the chosen one, else that of most objects; empty for none."""
        return target if target in self.classes else usual

    def click(self, path: str | None, target: str, cells: list[int], point: tuple[float, float]) -> tuple[object, ...]:
        """Look at the cell of a point.

        Args:
            path: file of the picture.
            target: the class that is looked for; empty for none yet.
            cells: the cells that were looked at before.
            point: `(x, y)` in pixels of the picture.

        Returns:
            All cells, the marks over the picture, and words about the last look.
        """
        if not target:
            return cells, "", _WHICH_OWN
        with _errors_on_page():
            are_numbers = isinstance(point, list | tuple) and all(
                isinstance(side, int | float) and abs(side) <= _FARTHEST for side in point
            )
            check(are_numbers and len(point) == 2, "point", "(x, y) in pixels of the picture", point)
            image = _read(path)
            grid = Grid(self.agent.columns, self.agent.rows, (image.shape[-1], image.shape[-2]))
            cell = int(grid.cell_of(torch.tensor([point]))[0])
            looks = look_at_cells(self.agent, image, target, [*cells, cell])
            # What follows the end of a search is no look of it.
            return looks.record.cells.tolist(), looks.marks(), looks.describe()

    def fresh(self, path: str | None, target: str) -> tuple[object, ...]:
        """Begin anew: no cells, the picture as the fovea sees it, no marks, and what to do."""
        with _errors_on_page():
            scene = "" if path is None else scene_json(self.agent, _read(path))
            return [], scene, "", _CLICK.format(target) if target else _WHICH_OWN


def _record_page(record: Record, picture: Tensor) -> str:
    """Make the page of a record, whose title is the outcome."""
    data = record.page_data(picture if record.kind.fine else None)
    data["decision"] = None  # which says it again
    return page_html(record.words.summary(), [data])


def _framed(page: str) -> str:
    """Put a page into a frame that shares nothing with the page around it."""
    return f'<iframe title="The looks" sandbox="allow-scripts" srcdoc="{escape(page)}"></iframe>'


def _share(text: str | None) -> PriorLike:
    """Read a share that was typed, or `fit`; None for an empty text. Whether it is one, a search checks."""
    typed = (text or "").strip()
    if not typed:
        return None
    if typed == "fit":
        return "fit"
    try:
        return float(typed)
    except ValueError:
        raise InputError(f"prior: expected fit, or a share above 0 and below 1, such as 0.2, got {typed}") from None


def _read(path: str | None) -> Tensor:
    """Read the picture in a file that was uploaded, `(3, H, W)`; one that a page should not wait for is refused."""
    if path is None:
        raise InputError(f"picture: expected {_PICTURE}, got none")
    check_data(Path(path).exists(), "picture", "it once more, as it is kept for an hour", "one from before")
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


class _Panel(NamedTuple):
    """What a person sets: components of Gradio."""

    picture: "gradio.Image"
    task: "gradio.Radio"
    target: "gradio.Dropdown"
    go: "gradio.Button"
    end: "gradio.Button"
    example: "gradio.Button"
    passes: "gradio.Slider"
    prior: "gradio.Textbox"


class _Views(NamedTuple):
    """What a person sees: components of Gradio, of the tab with the agent's looks and of that with the person's own."""

    words: "gradio.Markdown"
    shown: "gradio.HTML"
    about: "gradio.Markdown"
    own: "gradio.HTML"
    again: "gradio.Button"


def _make_page(agent: ActivePerception) -> "gradio.Blocks":
    """Make the page, a `gradio.Blocks`; pictures that it is given are removed within about an hour."""
    import gradio

    calls = _Calls(agent)
    sweeping = (_SECONDS_SWEPT, _SECONDS_KEPT)
    with gradio.Blocks(title="semfov", analytics_enabled=False, delete_cache=sweeping, fill_width=True) as page:
        gradio.Markdown("# semfov\nSee where it looks in a picture, and what it finds there.", elem_classes="title")
        with gradio.Row():
            with gradio.Column(scale=1, min_width=300, elem_id="panel"):
                panel = _lay_out_panel(calls)
            with gradio.Column(scale=2, min_width=300), gradio.Tabs():
                views = _lay_out_views()
        usual = gradio.State("")
        _connect_agent(page, calls, panel, views, usual)
        _connect_person(calls, panel, views, usual)
    return page


def _lay_out_panel(calls: _Calls) -> _Panel:
    """Lay out the picture, the task and its settings."""
    import gradio

    picture = gradio.Image(
        label="Picture", type="filepath", format="png", sources=["upload", "clipboard"], height=220,
        buttons=["fullscreen"], elem_id="picture",
    )  # fmt: skip
    # Gradio would open the file with any of Pillow's decoders, of which some start programs.
    picture.preprocess = lambda payload: payload and payload.path
    task = gradio.Radio(
        list(_TASKS), value="find all", label="What to do", show_label=False, container=False, elem_id="task"
    )
    with gradio.Row(elem_id="press"):
        target = gradio.Dropdown(
            [_EVERY, *calls.classes], value=_EVERY, label="Class", show_label=False, container=False,
            filterable=True, scale=3, min_width=120,
        )  # fmt: skip
        go = gradio.Button("Look", variant="primary", scale=2, min_width=70)
        end = gradio.Button("Stop", scale=1, min_width=60)
    with gradio.Accordion("More settings, and examples", open=False):
        example = gradio.Button("Next example", visible=bool(calls.examples))
        passes = gradio.Slider(1, 64, value=16, step=1, label="Looks at most")
        prior = gradio.Textbox(
            label="Share of your pictures that hold the class",
            placeholder="0.5",
            info="For a search; fit takes that of the fit.",
            interactive=False,
        )
    return _Panel(picture, task, target, go, end, example, passes, prior)


def _lay_out_views() -> _Views:
    """Lay out the tab with the agent's looks, and that in which a person looks."""
    import gradio

    with gradio.Tab("Its looks"):
        words = gradio.Markdown(_READY)
        shown = gradio.HTML(elem_classes="page")
    with gradio.Tab("Look yourself"):
        about = gradio.Markdown(_WHICH_OWN)
        own = gradio.HTML(
            value="", marks="", html_template=TEMPLATE, css_template=STYLE, js_on_load=SCRIPT, elem_id="own"
        )
        again = gradio.Button("Start again")
    return _Views(words, shown, about, own, again)


_PRIVATE: dict[str, Any] = {"api_visibility": "private"}  # calls of the page that are no interface for programs


def _connect_agent(page: "gradio.Blocks", calls: _Calls, panel: _Panel, views: _Views, usual: "gradio.State") -> None:
    """Connect the panel with the agent's looks; `usual` keeps the class of most objects in an example."""
    import gradio

    def look(
        path: str | None,
        target: str,
        task: str,
        passes: float,
        prior: str,
        request: gradio.Request,
    ) -> tuple[object, str]:
        words, page_of_record = calls.look(path, target, task, passes, prior, request.session_hash)
        return gradio.update(value=words, visible=bool(words)), page_of_record

    def stop(request: gradio.Request) -> None:
        calls.stop(request.session_hash)

    def suit(task: str, target: str, usual: str) -> tuple[object, ...]:
        used = _TASKS[task]
        chosen = calls.sought(target, usual) or _EVERY if task == "search" else target
        return (
            gradio.update(interactive=used.by_class, value=chosen),
            gradio.update(interactive=used.by_passes),
            gradio.update(interactive=used.by_prior),
        )

    number = gradio.State(0)
    example = [panel.picture, panel.target, usual, number]
    settings = [panel.picture, panel.target, panel.task, panel.passes, panel.prior]
    page.load(calls.take, [number, panel.task], example, queue=False, **_PRIVATE)
    panel.example.click(calls.take, [number, panel.task], example, **_PRIVATE)
    panel.picture.input(lambda: "", [], [usual], queue=False, **_PRIVATE)
    fields = [panel.target, panel.passes, panel.prior]
    panel.task.change(suit, [panel.task, panel.target, usual], fields, queue=False, **_PRIVATE)
    panel.go.click(look, settings, [views.words, views.shown], **_PRIVATE)
    panel.end.click(stop, [], [], queue=False, **_PRIVATE)


def _connect_person(calls: _Calls, panel: _Panel, views: _Views, usual: "gradio.State") -> None:
    """Connect the picture with the looks of a person, which begin anew with another picture or class."""
    import gradio

    def fresh(path: str | None, target: str, usual: str) -> tuple[object, ...]:
        cells, scene, marks, about = calls.fresh(path, calls.sought(target, usual))
        return cells, gradio.update(value=scene, marks=marks), about

    def click(
        path: str | None, target: str, usual: str, cells: list[int], event: gradio.EventData
    ) -> tuple[object, ...]:
        looked, marks, about = calls.click(path, calls.sought(target, usual), cells, event.index)
        return looked, gradio.update(marks=marks), about

    cells = gradio.State([])
    sought = [panel.picture, panel.target, usual]
    shown = [cells, views.own, views.about]
    # One picture at a time is read for these, and another one for a search.
    one_at_a_time = {"concurrency_id": "own looks", **_PRIVATE}
    for changed in (panel.picture.change, views.again.click, panel.target.change):
        changed(fresh, sought, shown, **one_at_a_time)
    views.own.select(click, [*sought, cells], shown, **one_at_a_time)
