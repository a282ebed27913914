"""Memory over a long flight that never returns: `python -m benchmarks.endless`.

A camera flies in a straight line over a plane of photographs without an end. Every tile of the plane is a part of a
photograph, chosen by the place of the tile and a seed. At some frames the memory of the process is read, and what the
stream holds is counted: looks, objects, and the rows of all arrays and tensors.
"""

import gc
import os
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import NamedTuple

import numpy as np
import torch

from benchmarks.machine import describe, use_threads
from benchmarks.tables import command, page, table, write
from semfov import ActivePerception
from semfov.data.examples import example
from semfov.data.images import to_bytes
from semfov.live import LivePerception
from semfov.paths import WindowMoment

SIZE = (640, 480)
TILE = 320  # side of a tile, in pixels
SHIFT = (12, 5)  # pixels that the camera moves a frame
PHOTOGRAPHS = ("beach", "market", "lifeboat", "farm")
TASKS: dict[str, str | list[str]] = {"find": ["person"], "search": "person"}
FRAMES = (500, 1000, 2500, 5000)

_NOT_HELD = (ModuleType, type, FunctionType, CodeType)  # what leads from an object to all of the program


class Held(NamedTuple):
    """What a stream holds at a frame.

    Attributes:
        frame: number of frames so far.
        megabytes: memory of the process.
        looks: number of looks that count.
        tracks: number of objects that are known.
        arrays: number of arrays and tensors that the stream leads to.
        rows: their rows.
    """

    frame: int
    megabytes: float
    looks: int
    tracks: int
    arrays: int
    rows: int


class Plane:
    """A plane of tiles without an end, each a part of a photograph.

    Args:
        seed: seed of the tiles.
    """

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed
        self.photographs = [to_bytes(example(name)) for name in PHOTOGRAPHS]
        self._tile: Callable[[int, int], np.ndarray] = lru_cache(maxsize=32)(self._made)

    def _made(self, row: int, column: int) -> np.ndarray:
        """Cut a tile `(TILE, TILE, 3)` out of a photograph, half of the tiles mirrored."""
        generator = np.random.default_rng((self.seed, row, column))
        photograph = self.photographs[generator.integers(len(self.photographs))]
        height, width = photograph.shape[:2]
        top = generator.integers(height - TILE + 1)
        left = generator.integers(width - TILE + 1)
        tile = photograph[top : top + TILE, left : left + TILE]
        return tile[:, ::-1] if generator.integers(2) else tile

    def view(self, left: int, top: int) -> np.ndarray:
        """Show a frame of the plane, `(height, width, 3)` bytes, whose first pixel is at a place of it."""
        width, height = SIZE
        rows = range(top // TILE, (top + height - 1) // TILE + 1)
        columns = range(left // TILE, (left + width - 1) // TILE + 1)
        tiles = np.block([[[self._tile(row, column)] for column in columns] for row in rows])
        y = top - rows.start * TILE
        x = left - columns.start * TILE
        return np.ascontiguousarray(tiles[y : y + height, x : x + width])


def resident() -> float:
    """Read the memory of the process that is resident now, in MB, as Linux counts it."""
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def arrays_of(root: object) -> Iterator[np.ndarray | torch.Tensor]:
    """Find the arrays and tensors that an object leads to, without those of modules and classes."""
    seen = {id(root)}
    waiting = [root]
    while waiting:
        found = waiting.pop()
        if isinstance(found, np.ndarray | torch.Tensor):
            yield found
        for referent in gc.get_referents(found):
            if id(referent) not in seen and not isinstance(referent, _NOT_HELD):
                seen.add(id(referent))
                waiting.append(referent)


def held(live: LivePerception, moment: WindowMoment, frame: int) -> Held:
    """Read the memory, and count what a stream holds."""
    gc.collect()
    megabytes = resident()
    arrays = list(arrays_of(live))
    rows = sum(len(array) for array in arrays if array.ndim)
    return Held(frame, megabytes, len(moment.looks), len(moment.tracks), len(arrays), rows)


def fly(agent: ActivePerception, task: str, frames: Sequence[int], seed: int) -> list[Held]:
    """Fly over the plane, and say what is held at some frames."""
    plane = Plane(seed)
    live = agent.live(TASKS[task], how="windows")
    states = []
    for number in range(max(frames)):
        moment = live.step(plane.view(SHIFT[0] * number, SHIFT[1] * number))
        assert isinstance(moment, WindowMoment)
        if number + 1 in frames:
            states.append(held(live, moment, number + 1))
            print(task, states[-1], flush=True)
    return states


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Fly, and write the table."""
    parser = command("benchmarks.endless", __doc__, seconds=0.0)
    parser.add_argument("--frames", type=int, nargs="+", default=FRAMES, help="frames at which memory is read")
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=[*TASKS], help="what the streams look for")
    parser.add_argument("--seed", type=int, default=0, help="seed of the plane")
    options = parser.parse_args(arguments)
    use_threads(options.threads)
    about = describe()
    agent = ActivePerception.recommended("yolox-nano")
    flights = {task: fly(agent, task, options.frames, options.seed) for task in options.tasks}
    head = ["task", "frame", "memory, MB", "looks that count", "objects known", "arrays held", "their rows"]
    rows = []
    for task, states in flights.items():
        for state in states:
            counts = (state.looks, state.tracks, state.arrays, state.rows)
            rows.append([task, f"{state.frame:,}", f"{state.megabytes:,.0f}", *(f"{count:,}" for count in counts)])
    text = page("Memory of a stream", TEXT, about, table(head, rows))
    written = {task: [state._asdict() for state in states] for task, states in flights.items()}
    write(options.out, "endless", text, {"machine": about, "flights": written})


TEXT = f"""\
Written by `python -m benchmarks.endless`. YOLOX-nano looks at windows of {SIZE[0]} x {SIZE[1]} px, one a frame, while
the camera flies by {SHIFT[0]} and {SHIFT[1]} px a frame over a plane of photographs and never returns. Streams follow
each other in one process: one that finds all people, and one that searches for a person. Arrays are those of NumPy and
PyTorch that a stream leads to, its models among them."""


if __name__ == "__main__":
    main()
