"""Learn to verify targets: `python -m train.fit_verification` fits what closer looks tell before a search ends.

    python -m train.fit_verification --data.root DIR --data.annotations instances.json --out runs/fit_verification

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

The agent searches the photographs for present and for absent classes with its learned target evidence. After some looks
the places that seem to hold the target are looked at closely: a window around each is enlarged to the detector's input.
Two logistic regressions learn from these closer looks whether the target is at the place, and whether it is in the
photograph. Then the searches are repeated, each with a model that was fitted to other photographs, to evaluate the
decisions and to choose their threshold. The folder `out` gets the model (`<name>.safetensors`) and the report. All
looks are stored, photograph by photograph, in the folder `cache`: the same command continues an interrupted fit.
"""

import sys

from semfov.fit.verification import FitVerificationConfig, fit_verification
from semfov.runs.command import command

main = command(fit_verification, FitVerificationConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
