"""Fit a foveal observation model: `python -m train.fit_fom` learns how a detector scores what it sees off-centre.

    python -m train.fit_fom --data.root DIR --data.annotations instances.json --out runs/fit_fom

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

Every photograph is fixated at random points. The detections are matched to the annotated boxes, and p(scores | class,
distance to the fovea) is fitted to them. The folder `out` gets the model (`<name>.safetensors`), a report that
evaluates it on held-out photographs, and a reliability diagram. If a run is interrupted, repeat the command to
continue. Several machines share the work with
`--scheduler` (docs/guides/cluster.md).

Use the model with `--belief.model runs/fit_fom/<name>.safetensors`.
"""

import sys

from semfov.fit.observation import FitObservationConfig, fit_fom
from semfov.runs.command import command

main = command(fit_fom, FitObservationConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
