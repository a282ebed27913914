"""The looks of a person at a picture on the page of `semfov app`: what they show, and the agent's own beside them."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.agent import ActivePerception
from semfov.data.classes import amount
from semfov.detection.placement import resize
from semfov.paths import Record, Scanpath
from semfov.paths.look import confident_detections, detections_in_words
from semfov.report.episode import jpeg_uri
from semfov.sensor.foveation import Foveation
from semfov.sensor.pyramid import gaussian_pyramid
from semfov.settings import SearchSettings

SCRIPT = (Path(__file__).parent / "own_looks.js").read_text(encoding="utf-8")
"""Draws the scene and its marks, and tells a click as the event `select`."""

TEMPLATE = """<div class="own">
<div class="stage">
<canvas tabindex="0" role="img" aria-label="What the fovea sees. Arrow keys move it, Enter looks."></canvas>
<svg aria-hidden="true"></svg></div>
<label><input type="checkbox" checked> Show where it may be, in orange</label>
</div>"""

STYLE = """.stage { position: relative; line-height: 0; }
canvas { width: 100%; height: auto; cursor: crosshair; touch-action: pan-y; border-radius: 8px; }
svg { position: absolute; inset: 0; width: 100%; height: 100%; pointer-events: none; }
label { display: inline-flex; gap: 0.4rem; align-items: center; margin-top: 0.5rem; }
.own:has(input:not(:checked)) .belief { display: none; }"""

_QUALITY = 85  # of the JPEGs


class OwnLooks(NamedTuple):
    """The looks of a person.

    Attributes:
        record: the record of the looks.
        advice: the cell that the agent would look at next.
        agent: the agent's search from the same first look; None while the person's search goes on.
    """

    record: Scanpath
    advice: int
    agent: Record | None

    @property
    def point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, where the agent would look next."""
        x, y = self.record.grid.centres[self.advice].tolist()
        return x, y

    def describe(self) -> str:
        """Describe the last look and the belief, and at the end the number of looks, as Markdown."""
        record = self.record
        assert record.presence is not None
        chances = record.presence.tolist()
        before = f" ({chances[-2]:.2f} before it)" if len(chances) > 1 else ""
        detections = detections_in_words(record.looks[-1].detections, record.classes)
        last = (
            f"**Look {record.looks[-1].number}** shows {detections}. "
            f"The probability that the picture holds “{record.target_name}” is {chances[-1]:.2f}{before}."
        )
        if self.agent is None:
            return f"{last} The agent would look next at the ring."
        outcomes = f"You: {_outcome(record)}. The agent: {_outcome(self.agent)}"
        return f"**{outcomes}**, from the same first look.\n\n{last}"

    def marks(self) -> str:
        """Collect the points and boxes to draw over the picture, in its pixels, as JSON."""
        record = self.record
        grid, belief = record.belief_map(len(record) - 1)  # (X·Y,)
        detections = confident_detections(record.looks[-1].detections)[0]
        boxes = detections.boxes[detections.labels == record.target]
        return json.dumps(
            {
                "looks": record.fixations.tolist(),
                "next": None if self.agent is not None else self.point,
                "grid": [grid.columns, grid.rows],
                "belief": belief.tolist(),
                "boxes": boxes.tolist(),
            }
        )


def _outcome(record: Record) -> str:
    """Say whether the target was found, and in how many looks."""
    count = amount(len(record), "look")
    return f"found in {count}" if record.found else f"not found in {count}"


def look_at_cells(agent: ActivePerception, image: Tensor, target: str, cells: Sequence[int]) -> OwnLooks:
    """Look at cells of a picture one after the other, in a search that ends as the agent's own.

    Args:
        agent: the agent.
        image: the picture, `(3, H, W)`.
        target: the class that is searched for.
        cells: the cells; those after the end of the search are left out.

    Returns:
        The looks.
    """
    # Looks are compared by their number, and a person makes no closer ones.
    settings = SearchSettings(closer=0)
    with torch.inference_mode():
        episode = agent.fovea.open_search(image[None].to(agent.eye.sensor.like), target, settings, cells)
        for _ in cells:
            episode.look()
            if episode.ending is not None:
                break
    record = episode.record()
    # The agent does not fixate a cell twice, so none of these is its advice.
    values = record.values[-1].index_fill(0, record.cells, -torch.inf)
    of_agent = None if episode.ending is None else agent.search(image, target, how="fovea", start=cells[0], closer=0)
    return OwnLooks(record, int(values.argmax()), of_agent)


def scene_json(agent: ActivePerception, image: Tensor) -> str:
    """Collect what a script needs to show a picture as the fovea sees it from any point, as JSON.

    It is given the levels of the Gaussian pyramid at the detector's resolution, and the width of the fovea. A sensor
    that is no `Foveation` has one level, the sharp picture.

    Args:
        agent: the agent.
        image: the picture, `(3, H, W)`.

    Returns:
        Size of the picture in pixels, its levels as JPEGs, and the widths along x and y in pixels of the picture.
    """
    sensor = agent.eye.sensor
    sigma = [1.0, 1.0]
    growth = 1.0
    with torch.inference_mode():
        view = agent.eye.open(image)
        width, height = view.placement.size
        scale = torch.tensor(view.placement.scale)
        columns, rows = (max(1, round(side)) for side in (scale * torch.tensor([width, height])).tolist())
        sharp = resize(image[None].float(), (columns, rows))
        levels: tuple[Tensor, ...] = (sharp,)
        if isinstance(sensor, Foveation):
            levels = gaussian_pyramid(sharp, sensor.levels, sensor.convention)
            _, sigma_on_canvas = view.state
            # The page draws in pixels of the picture.
            sigma = (sigma_on_canvas.flatten().cpu() / scale).tolist()
            growth = float(torch.as_tensor(sensor.growth))
    scene = {
        "size": [width, height],
        "pixels": [columns, rows],
        "sigma": sigma,
        "growth": growth,
        "levels": [jpeg_uri(level[0], level.shape[-1], _QUALITY) for level in levels],
    }
    return json.dumps(scene)
