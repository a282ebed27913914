"""Fit evidence by magnification: `python -m train.fit_zoom` learns where closer looks find objects.

    python -m train.fit_zoom --data.root DIR --data.annotations instances.json --out runs/fit_zoom

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The detector looks at mosaics of 4 × 4 and of 8 × 6 photographs and at other kinds of pictures that are composed of
photographs (`kinds`), in windows at steps of half a window and at all magnifications. The model learns to predict the
results of closer looks from coarser looks at the same place. The folder `out` gets the model (`<name>.safetensors`),
and a report that evaluates it on mosaics of held-out photographs. If the looking is interrupted, repeat the command to
continue.
"""

import sys

from semfov.fit.windows import FitZoomConfig, fit_zoom
from semfov.runs.command import command

main = command(fit_zoom, FitZoomConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
