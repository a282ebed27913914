"""Fit evidence by magnification: `python -m train.fit_zoom` looks at mosaics and learns where closer looks pay.

    python -m train.fit_zoom --data.root DIR --data.annotations instances.json --out runs/fit_zoom

Without photographs it uses the embedded scenes, which is only good for trying it out.

Mosaics of 4 × 4 and of 8 × 6 photographs are looked at in windows half a window apart, at all magnifications. What
coarse looks show and what closer looks find in the same place is learned from. The folder `out` gets the model
(`<name>.safetensors`), and a report that judges it on mosaics of photographs that were held out. Looking goes on where
it was when the same command is given again.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.zoom import fit_zoom
from semfov.training.zoom_settings import FitZoomConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_zoom, FitZoomConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
