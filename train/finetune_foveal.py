"""Train a detector's heads on foveal views: `python -m train.finetune_foveal` teaches them to see what is blurred.

    python -m train.finetune_foveal --data.root DIR --data.annotations instances.json --out runs/finetune_foveal

Without photographs it uses the embedded scenes, which is only good for trying it out.

Every photograph is seen through `RandomFoveation` from a few random places. The last convolutions before the heads of
YOLOv3-tiny, or of another of Darknet's detectors, are trained by YOLOv3's loss on what the rest of the network gives
for these views, which is computed once. Photographs that were held out choose learning rate and epoch. The folder `out`
gets the new detector (`<name>.onnx`), which `semfov.load_detector` takes, and a report. A run that was stopped goes on
where it was when the same command is given again. Compare it with calibrating: `python -m eval.foveal_training`.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.foveal import finetune
from semfov.training.foveal_settings import FinetuneConfig


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(finetune, FinetuneConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
