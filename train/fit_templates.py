"""Fit class templates: `python -m train.fit_templates` averages a detector's features over the objects of each class.

    python -m train.fit_templates --data.root DIR --data.annotations instances.json --out runs/fit_templates

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

Every photograph is passed through the detector once, without foveation. The features at the centres of the annotated
objects are averaged for each class. These averages are the templates of IVSN. The folder `out` gets
the model (`<name>.safetensors`) and a report that evaluates it on held-out photographs.

Use the model with `python -m eval.ivsn --templates runs/fit_templates/<name>.safetensors`.
"""

import sys

from semfov.runs.command import command
from train.templates import FitTemplatesConfig, fit_templates

main = command(fit_templates, FitTemplatesConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
