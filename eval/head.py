"""A head that turns: `python -m eval.head` looks around in scenes that are larger than the field of the eye.

    python -m eval.head                                                   # panoramas of embedded scenes
    python -m eval.head --data.root DIR --data.annotations instances.json --scenes 40
    python -m eval.head --data.root DIR --data.annotations instances.json --scene mosaic
    python -m eval.head --fields '[40, 80]'                                # the head zooms, too

Eye and head by the gain that is expected per second, beside a head that scans in raster or in random order, both at
random, and an eye whose head stays. The tables have what is found by the second and by the pass, and what is known.
A run that was stopped goes on where it was when the same command is given again.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.experiments.head import HeadConfig
from semfov.experiments.head_report import head


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(head, HeadConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
