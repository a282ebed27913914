"""Fuzz what a file makes the process do, at every door: files, requests, processes, memory and time."""

import contextlib
import io
import warnings
from collections.abc import Callable
from functools import cache
from itertools import islice
from pathlib import Path

import torch
from PIL import Image

from benchmarks.fuzz.containers import CONTAINERS, CONTENTS, RECORDINGS, SIDE, content_of, mosaic, suffix_of
from benchmarks.fuzz.runner import Case, Draw
from benchmarks.fuzz.watch import MOST_SECONDS, Outcome, listener, opened_files, watched
from semfov import ActivePerception, read_image
from semfov.cli import app
from semfov.cli.main import main
from semfov.cli.picture_tools import PictureTools
from semfov.data.fixations import read_fixations
from semfov.data.large import open_large
from semfov.data.sources import open_stream
from semfov.errors import DataError

SIDECARS = ("none", "{name}.ovr", "{name}.aux.xml", "{name}.msk", "{stem}.wld", "{stem}.prj", "{stem}.json")
CLAIMS = (SIDE, SIDE, 20_000, 100_000, 1_000_000, 2**31 - 1)
MOST_BYTES = 512 << 20
BYTES_PER_BYTE = 200


def resources(draw: Draw, folder: Path) -> Case:
    """Every door: a result or an error, within memory and time, and no other file, request or process."""
    public = folder / "public"
    private = folder / "private"
    for place in (public, private):
        place.mkdir()
    secret = private / "secret.tif"
    Image.new("RGB", (SIDE, SIDE), (201, 201, 201)).save(secret)
    container = draw.choose(CONTAINERS, "container")
    content = draw.choose(CONTENTS, "content")
    sidecar = draw.choose(SIDECARS, "sidecar")
    claim = draw.choose(CLAIMS, "claimed side")
    door = draw.choose(DOORS, "door")
    path = public / f"a.{suffix_of(container)}"

    def call() -> Outcome:
        with listener() as (address, requests):
            names = [str(secret), f"/vsicurl/{address}/a.tif"]
            path.write_bytes(content_of(container, content, claim, names, draw.rng))
            if sidecar != "none":
                beside = public / sidecar.format(name=path.name, stem=path.stem)
                beside.write_text(mosaic(draw.rng.choice(names), SIDE))
            most = MOST_BYTES + BYTES_PER_BYTE * path.stat().st_size
            _agent()  # is loaded once
            with opened_files(public, private) as opened:
                outcome = watched(lambda: _enter(door, path), most)
        strange = sorted(opened - {path.name}) + [str(request) for request in requests]
        assert outcome.fault is None, outcome.fault
        assert not outcome.forbidden + strange, outcome.forbidden + strange
        assert outcome.bytes <= most, f"{outcome.bytes:,} bytes, at most {most:,}"
        assert outcome.seconds <= MOST_SECONDS, f"{outcome.seconds:.1f} s"
        if outcome.refused is not None:
            raise DataError(outcome.refused)
        return outcome

    return Case(call, lambda _: None, may=True, must=False)


def _enter(door: str, path: Path) -> object:
    """Go in by a door. What warnings say, such as that of several pages one is shown, is no fault."""
    torch.set_num_threads(1)  # a fork has none of the threads of its process, and would wait for them
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return DOORS[door](path)


@cache
def _agent() -> ActivePerception:
    """Load the agent."""
    return ActivePerception.recommended()


def _open(path: Path) -> None:
    """Open a picture for windows, and look at the whole of it and at a corner."""
    picture = open_large(path)
    width, height = picture.size
    picture.read((0, 0, width, height), picture.reduction(width / 64))
    picture.read((0, 0, min(width, 64), min(height, 64)))


def _check(path: Path) -> None:
    """Check fixations by the picture, or those that a recording has."""
    if path.suffix[1:] in RECORDINGS:
        _run("check", str(path))
        return
    people = path.parent.with_name("people.csv")
    people.write_text("picture,subject,x,y,width,height\n" + f"{path.name},a,1,1,{SIDE},{SIDE}\n" * 6)
    _run("check", str(people), "--picture", str(path.parent))


def _stream(path: Path) -> None:
    """Read the first frames of a film, or of a picture that is taken for one."""
    for _ in islice(open_stream(path).frames, 5):
        pass


def _tools(path: Path) -> None:
    """Let a language model look for people in the picture, look at its corner, and ask where people look."""
    tools = PictureTools(path.parent, _agent())
    tools.find(path.name, ["person"], 2)
    tools.look(path.name, 9, 9, 20)
    tools.where_people_look(path.name)


def _run(*words: str) -> None:
    """Run the command; raises `DataError` with its last line where it fails."""
    told = io.StringIO()
    try:
        with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
            main([*words])
    except SystemExit as end:
        text = told.getvalue()
        assert "Traceback" not in text, text[-1000:]
        if end.code:
            raise DataError(text.strip().splitlines()[-1][:500]) from None


DOORS: dict[str, Callable[[Path], object]] = {
    "read": read_image,
    "open": _open,
    "search": lambda path: _agent().search(path, "cup", passes=2),
    "find": lambda path: _agent().find_all(path, "person", passes=2),
    "fovea": lambda path: _agent().search(path, "cup", how="fovea", shifts=2),
    "gaze": lambda path: _agent().gaze(path),
    "stream": _stream,
    "recording": read_fixations,
    "mcp": _tools,
    "check": _check,
    "app": lambda path: app._read(str(path)),  # what reads uploads has no public name
    "command": lambda path: _run("find", str(path), "--target", "person", "--passes", "2"),
}
"""Ways of a file into semfov."""
