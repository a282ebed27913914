"""Pictures larger than the detector's input: `python -m eval.zoom` compares ways to choose place and magnification.

    python -m eval.zoom                                                   # mosaics of embedded scenes
    python -m eval.zoom --data.root DIR --data.annotations instances.json --mosaics 100
    python -m eval.zoom --data.root DIR --data.annotations instances.json --mosaics 0 --target person

It compares slices in raster order, in random order and ranked by the overview, a best-first quad-tree, our method, and
an oracle. The tables give recall after n passes of the detector, for mosaics the passes to the first confirmed hit, and
decisions. To continue a stopped run, give the same command again.
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
