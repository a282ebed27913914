"""Fine-tune a detector's heads on foveal views: `python -m train.finetune_foveal` trains it to see blurred objects.

    python -m train.finetune_foveal --data.root DIR --data.annotations instances.json --out runs/finetune_foveal

Without photographs, the command uses the embedded scenes, which is enough only to try it out.

`RandomFoveation` foveates every photograph at a few random points. The command trains the last convolutions before the
heads of YOLOv3-tiny, or of another Darknet detector, with YOLOv3's loss. The features of the other layers are computed
once for each view. The learning rate and the epoch are chosen on held-out photographs.

The folder `out` gets a report and the new detector (`<name>.onnx`), which `semfov.load_detector` loads. If a run is
interrupted, repeat the command to continue. `python -m eval.foveal_training` compares the result with calibration.
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
