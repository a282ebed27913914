"""Pictures larger than the detector's input: `python -m eval.zoom` compares where to look, and how close.

    python -m eval.zoom                                                   # mosaics of embedded scenes
    python -m eval.zoom --data.root DIR --data.annotations instances.json --mosaics 100
    python -m eval.zoom --data.root DIR --data.annotations instances.json --mosaics 0 --target person

Slices in raster and in random order, slices ranked by the overview, a quad-tree best first, ours, and an oracle. The
tables have recall after so many passes of the detector, and for mosaics the passes to the first confirmed hit. A run
that was stopped goes on where it was when the same command is given again.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.experiments.zoom import ZoomConfig
from semfov.experiments.zoom_report import zoom


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(zoom, ZoomConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
