"""How well the gaze model tells photographs from pictures unlike those of its fit: pages, charts, drawings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from tqdm import tqdm

from eval.human.drawn_pictures import KINDS, web_page_with_photograph
from eval.human.viewing import write_tables
from semfov.data.inputs import as_image
from semfov.data.picture_files import picture_files
from semfov.data.reading import read_image
from semfov.detection.load import load_detector
from semfov.errors import check
from semfov.gaze.saliency.fixation_density import FixationDensity
from semfov.gaze.saliency.likeness import PictureLikeness, pooled
from semfov.human.viewing import MapSource, features_of
from semfov.io.ranges import Count, Range, Seed
from semfov.metrics.episodes import area_under_roc
from semfov.runs.config import DetectorConfig
from semfov.runs.settings import Settings
from semfov.runs.setup import detector_options
from semfov.runs.tables import table
from semfov.runs.workers import prepare_worker

_TINY = (24, 18)


@dataclass(frozen=True)
class UnlikeConfig(Settings):
    """Photographs and drawn pictures, and the detectors whose feature maps tell them apart.

    Args:
        fitted: folders of the pictures of the fit (none: the distance is the one that is shipped, which is measured on
            other photographs alone); the distance is fitted to every second one, and measured on the
            others.
        others: folder of other photographs, on which nothing was fitted or chosen.
        detectors: the detectors, each by name or by settings.
        count: number of drawn pictures of each kind.
        limit: number of other photographs, spread over the folder (none: all).
        seed: seed of all drawn pictures.
        page: page with a place for the table (`<!-- table unlike -->` to `<!-- end -->`); none: it is left alone.
        out: folder for the table.
    """

    fitted: tuple[Path, ...] = ()
    others: Path | None = None
    detectors: tuple[str | DetectorConfig, ...] = ("yolov3-tiny", "yolox-nano", "nanodet-plus-m-1.5x")
    count: Annotated[int, Range(2, 10_000)] = 40
    limit: Count | None = None
    seed: Seed = 1
    page: Path | None = None
    out: Path = Path("runs/human_unlike")


def tell_apart(config: UnlikeConfig) -> None:
    """Fit the distance to half of the pictures, measure all others, and write the table."""
    check(config.others is not None, "others", "a folder of photographs", "none")
    assert config.others is not None
    prepare_worker()
    files = [path for folder in config.fitted for path in picture_files(folder)]
    every_file = picture_files(config.others)
    others = every_file[:: max(1, len(every_file) // (config.limit or len(every_file)))][: config.limit]
    detectors = [DetectorConfig(name=each) if isinstance(each, str) else each for each in config.detectors]
    columns = {each.name: _measured(each, files, others, config) for each in detectors}
    lines = unlike_table(columns)
    write_tables("\n".join([*lines, ""]), {"unlike": lines}, config.out, config.page)


def _measured(
    detector: DetectorConfig, files: Sequence[Path], others: Sequence[Path], config: UnlikeConfig
) -> dict[str, Tensor]:
    """Compute the distances of all pictures by their kind, with the feature maps of a detector."""
    name = detector.name
    source = features_of(load_detector(name, **detector_options(detector)))
    made: dict[str, tuple[Iterable[Tensor], int]] = {OTHERS: (_read(others), len(others))}
    if files:
        likeness = PictureLikeness.fitted(_pooled(_read(files[::2]), source, f"{name}, fit", len(files[::2])))
        made = {FITTED: (_read(files[1::2]), len(files[1::2])), **made}
    else:
        likeness = _shipped(name)
    drawn = {**KINDS, **_changed(others)}
    for number, (kind, draw) in enumerate(drawn.items()):
        made[kind] = (_drawn(draw, config.seed, number, config.count), config.count)
    return {
        kind: likeness(_pooled(pictures, source, f"{name}, {kind}", count)) for kind, (pictures, count) in made.items()
    }


def _shipped(name: str) -> PictureLikeness:
    """Give the distance that is shipped for a detector."""
    model = FixationDensity.if_shipped(name)
    check(model is not None, "fitted", f"folders of pictures, as no model is shipped for {name}", "none")
    assert model is not None
    assert model.likeness is not None
    return model.likeness


FITTED = "photographs like those of the fit"
OTHERS = "other photographs"


def _changed(files: Sequence[Path]) -> dict[str, Callable[[np.random.Generator], Image.Image]]:
    """List what is made of a photograph, by name."""

    def photograph(rng: np.random.Generator) -> Image.Image:
        """Draw a photograph."""
        with Image.open(files[int(rng.integers(len(files)))], formats=("JPEG", "PNG")) as image:
            return image.convert("RGB")

    return {
        "web pages with a photograph": lambda rng: web_page_with_photograph(rng, files),
        "photographs in black and white alone": lambda rng: photograph(rng).convert("1").convert("RGB"),
        f"photographs of {_TINY[0]} × {_TINY[1]} px": lambda rng: photograph(rng).resize(_TINY),
        "photographs upside down": lambda rng: photograph(rng).rotate(180),
    }


def _drawn(draw: Callable[[np.random.Generator], Image.Image], seed: int, kind: int, count: int) -> Iterator[Tensor]:
    """Draw pictures of one kind, each from a seed of its own."""
    for number in range(count):
        yield as_image(draw(np.random.default_rng([seed, kind, number])))


def _read(files: Iterable[Path]) -> Iterator[Tensor]:
    """Read photographs, one after the other."""
    for file in files:
        yield read_image(file)


@torch.no_grad()
def _pooled(pictures: Iterable[Tensor], source: MapSource, title: str, count: int) -> Tensor:
    """Compute the pooled values of pictures, `(N, P)`."""
    bar = tqdm(pictures, desc=title, total=count, unit="picture", leave=False)
    return torch.cat([pooled(source.maps(picture[None]), source.layers) for picture in bar])


def unlike_table(columns: dict[str, dict[str, Tensor]]) -> list[str]:
    """Make the table: for each kind the area under the ROC curve against all photographs, and the share called unlike.

    Args:
        columns: distances by kind, by name of the detector.

    Returns:
        The lines.
    """
    head = [""]
    for name in columns:
        head += [f"{name}: area", f"{name}: called unlike"]
    rows = [head]
    for kind in next(iter(columns.values())):
        row = [kind]
        for distances in columns.values():
            # Photographs are what the other kinds are told from.
            area = "" if kind in (FITTED, OTHERS) else f"{_area(distances, [kind]):.3f}"
            row += [area, _share_unlike(distances[kind])]
        rows.append(row)
    row_of_all = [f"all {len(KINDS)} kinds of pages, charts, drawings and flat pictures"]
    for distances in columns.values():
        of_all_kinds = torch.cat([distances[kind] for kind in KINDS])
        row_of_all += [f"{_area(distances, [*KINDS]):.3f}", _share_unlike(of_all_kinds)]
    return table([*rows, row_of_all])


def _share_unlike(distances: Tensor) -> str:
    """Write the share of distances that are called unlike."""
    return f"{100 * float((distances > 1).float().mean()):.0f} %"


def _area(distances: dict[str, Tensor], kinds: Sequence[str]) -> float:
    """Compute the area under the ROC curve of telling kinds of pictures from all photographs."""
    alike = torch.cat([distances[kind] for kind in (FITTED, OTHERS) if kind in distances])
    unlike = torch.cat([distances[kind] for kind in kinds])
    is_unlike = torch.cat([torch.zeros(len(alike), dtype=torch.bool), torch.ones(len(unlike), dtype=torch.bool)])
    return area_under_roc(torch.cat([alike, unlike]), is_unlike)
