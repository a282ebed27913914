"""Fit class templates: `python -m train.fit_templates` averages what objects look like to a detector.

    python -m train.fit_templates --data.root DIR --data.annotations instances.json --out runs/fit_templates

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is passed through the detector once, sharp. The features at the centres of the annotated objects are
averaged for each class, which gives the templates that the search `ivsn` goes by. The folder `out` gets the model
(`<name>.safetensors`) and a report that judges it on photographs that were held out.
Use it with `--policies [ivsn] --templates runs/fit_templates/<name>.safetensors`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.templates import FitTemplatesConfig, fit_templates


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_templates, FitTemplatesConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
