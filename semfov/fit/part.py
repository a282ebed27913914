"""What all parts of a model folder share: how a part is fitted, and the data and the earlier parts that it may use.

A part is fitted to stored looks:

    photographs ─► Looking: every look, stored ─► PartInputs ─► PartFit.fit() ─► PartResult
                                                      ▲                              │
                                                      └── the parts before it ◄──────┘
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import fields, replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import torch

from semfov.fit.samples import Samples
from semfov.fit.settings import FitConfig, FitDetectorConfig
from semfov.io.files import sha256
from semfov.io.manifest import Part
from semfov.io.pretrained import Pretrained
from semfov.model_folder import KINDS
from semfov.runs.config import ProtocolConfig
from semfov.runs.looking import Looking
from semfov.runs.seeds import generator_for

_Config = TypeVar("_Config", bound=FitConfig)

_FEW = 8  # detectors with fewer classes also learn from photographs that contain none of them
_MANY = 100  # with at least this many photographs, one in five is held out
_MOST_SHIFTS = 15  # maximum number of gaze shifts in the searches and explorations that are compared


class PartResult(NamedTuple):
    """A fitted part with its report.

    Attributes:
        part: its entry in the manifest.
        report: its section of the report, in Markdown.
        figures: names of the files of its figures, in the folder.
    """

    part: Part
    report: str
    figures: Sequence[str] = ()


class PartInputs:
    """The looks that all parts are fitted to, and the parts that are finished.

    Attributes:
        run: the photographs, and their looks from every cell of a grid.
        config: the settings of the whole fit, with the share that is held out of so many photographs.
        components: number of scores in all, K + 1.
        absent: number of absent classes to search for in a photograph; None: as many as present ones.
        protocol: the searches and explorations by which parts are compared.
        compared_at: number of gaze shifts after which they are compared.
        training: numbers of the photographs to learn from.
        held_out: numbers of the other photographs.
        judged: those of them on which searches and explorations are compared.
        results: the parts that are finished, by name.
    """

    def __init__(self, config: FitDetectorConfig, run: Looking) -> None:
        self.run = run
        # Of few photographs more are held out, so that there are some to compare on.
        holdout = config.holdout or (3 if len(run.scenes) < _MANY else 5)
        self.config = replace(config, holdout=holdout)
        self.components = len(run.scenes.classes) + 1
        self.absent = 2 if self.components <= _FEW else None
        shifts = min(_MOST_SHIFTS, self.config.columns * self.config.rows - 1)  # until all cells are fixated
        self.protocol = ProtocolConfig(shifts=shifts, seed=self.config.seed)
        self.compared_at = min(5, shifts)
        self.training = [index for index in range(len(run.scenes)) if index % holdout]
        self.held_out = [index for index in range(len(run.scenes)) if index % holdout == 0]
        self.judged: Sequence[int] = self.held_out[: self.config.judged]
        self.results: dict[str, PartResult] = {}

    def settings(self, kind: type[_Config], **own: Any) -> _Config:
        """Make the settings of a part: those of the whole fit by their names, except its `own`."""
        shared = {field.name for field in fields(self.config)} & {field.name for field in fields(kind)}
        return kind(**{name: getattr(self.config, name) for name in shared} | own)

    def model(self, name: str) -> Pretrained | None:
        """Return the model of a part, or None if the part has no model or the agent should not use it."""
        part = self.results[name].part
        return KINDS[name].from_pretrained(self.config.out / part.file) if part.used and part.file else None

    @cached_property
    def samples(self) -> Samples:
        """Labelled detections from a few random cells of each photograph."""
        run = self.run
        samples = []
        for index in range(len(run.scenes)):
            grid = run.grid(index)
            generator = generator_for("cells", self.config.seed, run.scenes.ids[index])
            cells = torch.randperm(len(grid), generator=generator)[: self.config.fixations]
            detections = run.detections(index)[cells]
            samples.append(Samples.of(detections, grid.centres[cells], run.scenes.annotation(index), index, iou=0.5))
        return Samples.join(samples)


class PartFit(ABC):
    """Base of the fits of all parts: each fits its part, compares it with the agent without it, and writes it."""

    settings: Any
    """The settings of the part, by name or as a dataclass. The part is fitted again if they change."""
    tasks: dict[str, float]
    """The tasks of the fit by the titles of their progress bars, with an estimate of their seconds on one core."""

    def __init__(self, inputs: PartInputs) -> None:
        self.inputs = inputs
        self.config = inputs.config
        self.run = inputs.run

    @abstractmethod
    def fit(self) -> PartResult:
        """Fit the part."""

    def write(self, name: str, model: Pretrained, used: bool, why: str, **settings: Any) -> Part:
        """Write the model of a part.

        Args:
            name: name of the part.
            model: its fitted model.
            used: whether the agent should use it.
            why: sentence about the comparison with the agent without it.
            settings: JSON values for the manifest.

        Returns:
            The entry of the part in the manifest.
        """
        file = f"{name}.safetensors"
        model.save(self.config.out / file)
        return Part(file, sha256(self.config.out / file), used, why, settings)

    @staticmethod
    def left_out(why: str) -> PartResult:
        """Make the result of a part that is not fitted, with the reason."""
        return PartResult(Part(None, None, False, why), f"{why.capitalize()}.")
