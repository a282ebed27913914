"""Settings for training a detector's heads on foveal views."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.settings import Count, Name, Positive, Range, Seed, Settings, Share, Workers


@dataclass(frozen=True)
class FinetuneConfig(Settings):
    """Train the heads of a Darknet detector on foveated photographs with boxes.

    Args:
        data: photographs to train on (by default all of them, however many objects they have).
        detector: the Darknet detector to train. Its thresholds for keeping boxes do not affect the training.
        sensor: the foveal sensor.
        name: name of the new detector (None: the detector's name with `-foveal`).
        depth: number of convolutions to train before each head, counted from the last; 1 trains only the last one.
        fixations: number of views of each photograph, each with a random fixation.
        foveated: share of the views that are foveated; the others are sharp.
        rates: learning rates to try for one epoch each. Training continues with the one that has the lowest loss on
            held-out photographs.
        epochs: maximum number of epochs, trials included.
        patience: training ends after this many epochs in a row without a lower loss on held-out photographs. Such
            epochs are undone, and the learning rate is divided by 3.
        batch: number of views in a step.
        ignore: a predicted box is not trained as background if its overlap (IoU) with an object is higher
            (`semfov.training.yolo_loss`).
        holdout: one in every n photographs is held out, to choose the learning rate and the epoch.
        seed: seed of the fixations and of the order of the views.
        out: folder for the detector and the report.
        cache: folder for the features of the untrained layers, which are removed at the end (None: `out`).
        workers: number of processes that compute the views (None: one for each CPU core). Training uses one.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    name: Name | None = None
    depth: Annotated[int, Range(1, 100)] = 2
    fixations: Count = 2
    foveated: Share = 1.0
    rates: tuple[Positive, ...] = (3e-5, 1e-4, 3e-4)
    epochs: Count = 8
    patience: Count = 2
    batch: Count = 16
    ignore: Share = 0.5
    holdout: Annotated[int, Range(2, 10**9)] = 10
    seed: Seed = 0
    out: Path = Path("runs/finetune_foveal")
    cache: Path | None = None
    workers: Workers | None = None
