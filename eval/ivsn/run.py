"""Searches with IVSN: the policies of `eval.search`, and attention by class templates in each scene."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from eval.comparison.looking import Candidate
from eval.ivsn.attention import Attending, TemplateAttention
from eval.ivsn.templates import ClassTemplates, at_points
from eval.search.run import SearchConfig, SearchRun
from semfov.errors import check
from semfov.runs.config import PolicyConfig
from semfov.runs.presets import AGENT
from semfov.threads import one_thread


@dataclass(frozen=True)
class IVSNConfig(SearchConfig):
    """Visual search with IVSN, which looks at what resembles the average object of the target's class.

    Args:
        policies: policies to compare, as for `eval.search`; `ivsn` is one more.
        templates: class templates, by name or file (None: those shipped for the detector).
        out: folder for tables, figures, per-episode records and the manifest.
    """

    policies: tuple[str | PolicyConfig, ...] = (
        "random",
        "non-predictive-raw",
        TemplateAttention.name,
        AGENT,
    )
    templates: str | None = None
    out: Path = Path("runs/ivsn")


class IVSNRun(SearchRun):
    """Visual search with IVSN among the policies."""

    config: IVSNConfig

    def __init__(self, config: IVSNConfig) -> None:
        super().__init__(config)
        self.templates = ClassTemplates.from_pretrained(config.templates or self.eye.detector.name)
        self.templates.check_eye(self.eye.settings(), self.eye.detector.classes)
        crops = self.eye.sensor.crops
        check(crops == 1, "sensor", "one view in a look, from which class templates are computed", f"{crops} crops")

    def depends_on(self) -> dict[str, Any]:
        """Return the templates, beside what any search depends on."""
        return {**super().depends_on(), "templates": self.templates.digest()}

    def candidate(self, name: str, index: int) -> Candidate:
        """Return the policy of this name in tables, for a scene."""
        candidate = super().candidate(name, index)
        if candidate.strategy.policy.function is not TemplateAttention:
            return candidate
        return Attending(candidate.strategy, attention=self.attention(index), fovea=self.config.sensor.fovea)

    def attention(self, index: int) -> Tensor:
        """Attention to every class in the cells of a scene, from every cell `(X·Y, K, X·Y)`; computed at each call."""
        tables = []
        with one_thread(), torch.inference_mode():
            image, grid = self.scenes[index].image, self.grid(index)
            view, points = self.eye.open(image[None]), grid.centres.to(image)
            for point in points:
                canvas = self.eye.foveated(view, point[None])
                maps = self.templates(self.eye.detector.head_input(canvas))
                tables.append(at_points(maps, points, view.placement, (canvas.shape[-1], canvas.shape[-2])))
        return torch.cat(tables)
