"""Settings of training a detector's heads on foveal views."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.settings import Count, Name, Positive, Range, Seed, Settings, Share, Workers


@dataclass(frozen=True)
class FinetuneConfig(Settings):
    """Train the heads of a Darknet detector on photographs with boxes, seen through the fovea.

    Args:
        data: photographs to train on (all of them: no selection by number of objects).
        detector: which detector, one of Darknet's; what it keeps of its boxes plays no part.
        sensor: the foveal sensor.
        name: name of the new detector (None: the detector's, and `-foveal`).
        depth: how many convolutions before each head are trained, the last ones; 1 is the map alone.
        fixations: views of each photograph, fixated at random.
        foveated: share of the views that are foveated; the others are sharp.
        rates: learning rates to try, an epoch each; the one with the least loss on held-out photographs goes on.
        epochs: most epochs, those of the trials among them.
        patience: training ends after so many epochs that were no better on held-out photographs; each of them is
            undone, and the learning rate divided by 3.
        batch: views in a step.
        ignore: a box that overlaps an object by more is no background (`semfov.training.yolo_loss`).
        holdout: every n-th photograph is kept out of the training, and chooses rate and epoch.
        seed: of the fixations, and of the order of the views.
        out: folder for the detector and the report.
        cache: folder for what the rest of the network gives, which is removed in the end (None: `out`).
        workers: processes that look (None: one for each CPU core); training has one.
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
