"""Settings of fits: those that several have in common, and those for fitting all models to a detector."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from semfov.errors import InputError
from semfov.fit.gaze_model import GazeModelFit
from semfov.io.ranges import Count, Positive, Range, Seed, Share, Side, SingleName, Whole
from semfov.runs.config import DataConfig, DetectorConfig, EyeConfig


@dataclass(frozen=True)
class FitConfig(EyeConfig):
    """Base of the settings of fits to a detector's looks at annotated photographs.

    Args:
        data: photographs to learn from (by default all of them, however many objects they have).
        seed: seed of all random choices.
        name: name of the model (None: the detector's name).
        out: folder for the model and the report.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    seed: Seed = 0
    name: SingleName | None = None


@dataclass(frozen=True)
class FitOnCellsConfig(FitConfig):
    """Base of the settings of fits on looks from the cells of a grid.

    Args:
        columns: columns of the grid.
        rows: rows of the grid.
    """

    columns: Side = 10
    rows: Side = 10

    @property
    def cells(self) -> tuple[int, int]:
        """Columns and rows of the grid."""
        return self.columns, self.rows


@dataclass(frozen=True)
class VerificationConfig(FitOnCellsConfig):
    """Fit the verification of targets.

    Args:
        classes: maximum number of present classes to search for in each photograph.
        absent: maximum number of absent classes to search for (None: as many as present ones).
        max_target_area: classes that cover a larger share of the image are not searched for.
        looks: number of looks in a search.
        place: least probability of a cell that is worth a closer look.
        stop_below: least probability of a cell that is worth a fixation.
        false_alarms: maximum share of absent targets that may be reported as found; it determines `confirm`.
        folds: number of parts of the photographs; each part is evaluated with a model that is fitted to the others.
    """

    classes: Count = 2
    absent: Count | None = None
    max_target_area: Positive = 0.2
    looks: Annotated[int, Range(2, 10_000)] = 12
    place: Share = 0.4
    stop_below: Share = 0.012
    false_alarms: Share = 0.01
    folds: Annotated[int, Range(2, 1000)] = 5


@dataclass(frozen=True)
class FitDetectorConfig(FitOnCellsConfig):
    """Fit all models that the agent needs to your own detector.

    Args:
        model: the detector: a name or a file, as for `semfov.load_detector`.
        data: photographs with boxes to learn from. All of them are used unless `data.limit` or `data.ids` selects some.
        detector: options of the detector; `model` gives its name.
        max_target_area: classes that cover a larger share of the image are not searched for.
        holdout: one in every n photographs is held out for the evaluation and for choosing thresholds (None: one in 5,
            or one in 3 if there are fewer than 100 photographs).
        judged: maximum number of held-out photographs on which searches and explorations are compared with raw scores,
            and to which the verification is fitted.
        fixations: looks at each photograph to fit the observation model to.
        steps: steps of the fit through the belief, by which searches land on their targets sooner.
        windows: also fit the evidence for pictures larger than the detector's input, if there are enough photographs.
        window_steps: training steps of that evidence.
        gaze: pictures that people viewed, to fit where people look to. Without photographs, nothing else is fitted.
        thin: the report lists classes with fewer objects than this in the training photographs.
        out: folder to write the models to.
    """

    unused = ("name",)
    model: Path | None = None
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    max_target_area: Positive = 0.2
    holdout: Annotated[int, Range(2, 10**9)] | None = None
    judged: Count = 100
    fixations: Count = 8
    steps: Count = 150
    windows: bool = True
    window_steps: Count = 400
    gaze: GazeModelFit = field(default_factory=GazeModelFit)
    thin: Whole = 20
    out: Path = Path("mymodels")

    def named(self) -> "FitDetectorConfig":
        """Return the settings with `model` as the detector's name, and with targets of all sizes in the photographs.

        Raises:
            InputError: the settings name no detector, or another one besides, or options of `gaze` without fixations.
        """
        default = DetectorConfig().name
        if self.model is None:
            raise InputError("model: expected the name or the file of a detector, got none")
        if self.detector.name not in (default, str(self.model)):
            raise InputError(
                f"detector.name: expected nothing, as model already names the detector ({str(self.model)!r}), got "
                f"{self.detector.name!r}"
            )
        if not self.gaze.fixations and self.gaze != GazeModelFit():
            raise InputError(
                "gaze.fixations: expected a file beside other options of gaze (--gaze.fixations FILE), got none"
            )
        # Photographs without the target are needed as negative examples.
        data = replace(self.data, max_target_area=None)
        return replace(self, data=data, detector=replace(self.detector, name=str(self.model)))
