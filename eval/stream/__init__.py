"""Streams of a camera that moves: `python -m eval.stream` flies over large pictures, and looks at each frame.

    python -m eval.stream --data.root DIR --data.annotations instances.json --courses [still,usual,turning]
    python -m eval.stream --data.root DIR --data.annotations instances.json --successive   # a film, a picture a frame
    python -m eval.stream --film MOT17-02                                                  # a film in MOT's form

A flight shows a part of a picture in each frame. Its course is a straight line that bounces at the borders of the
picture, at a speed, with turns, zoom or shaking. The tables compare one pass a frame of the agent (`live`), of slices
in turn and of the plainest memory that moves with passes at the whole frame and at all slices of each frame.
"""

from collections.abc import Sequence

from eval.stream.report import stream
from eval.stream.run import StreamConfig
from semfov.runs.command import run_command


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(stream, StreamConfig, __doc__, arguments, goes_on=False)
