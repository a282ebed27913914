"""What is kept of a look at a picture: texts, rows of results, figures, and its part of a page."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torch import Tensor

from semfov.agents.picture import PictureLike
from semfov.cli.options import ALL_DRAWINGS, Drawing, PictureOptions
from semfov.cli.results import kind_of
from semfov.cli.sources import PictureSource
from semfov.cli.text import looks_text, outcome_text
from semfov.cli.truth import Truth, read_truth
from semfov.data.classes import canonical_name
from semfov.io.files import plain_name
from semfov.paths import Record, Scanpath
from semfov.report.episode import jpeg
from semfov.viz.belief import plot_belief, plot_belief_bars
from semfov.viz.scanpath import plot_foveated_strip
from semfov.viz.semantic import plot_semantic_map
from semfov.viz.style import save_figure


@dataclass(frozen=True)
class PictureOutcome:
    """Outcome of a look at a picture: text, row of results, part of a page (as JSON values), figures, and other files.

    Figures lie in the folder of the picture, `files` where their paths say.
    """

    ended: str
    text: str
    row: dict[str, Any]
    episode: dict[str, Any] | None = None
    names: tuple[str, ...] = ()
    figures: Mapping[str, bytes] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)

    def values(self) -> dict[str, Any]:
        """The JSON values, from which `PictureOutcome(**values)` makes the outcome again without its files."""
        return {name: getattr(self, name) for name in ("ended", "text", "row", "episode", "names")}


def _result_row(
    record: Record,
    name: str,
    seconds: float,
    kind: str | None,
    file: Path | None = None,
    truth: Truth | None = None,
) -> dict[str, Any]:
    """Make the entry of a picture in a file of results."""
    picture = {**record.to_dict(), "picture": name, "seconds": round(seconds, 3), "ended": record.why_it_ended()}
    row: dict[str, Any] = {"picture": {key: value for key, value in picture.items() if key not in ("looks", "summary")}}
    if kind == ".geojson":
        collection = record.to_geojson(source=file)
        row["coordinates"] = collection["coordinates"]
        row["parts"] = [
            {**each, "properties": {"picture": name, **each["properties"]}} for each in collection["features"]
        ]
    elif truth is not None:
        sought = picture["targets"] or record.classes[1:]
        row["image_id"] = truth.image_id(name, (picture["width"], picture["height"]))
        row["categories"] = truth.categories(sought)
        ids = {canonical_name(each["name"]): each["id"] for each in row["categories"]}
        # Objects of other classes cannot be judged; their number is not that of a category.
        numbers = [ids.get(canonical_name(each), -1) for each in record.classes[1:]]
        results = record.to_coco(row["image_id"], numbers)
        row["parts"] = [each for each in results if each["category_id"] != -1]
    elif kind == ".coco.json":
        row["categories"] = _categories(record.classes[1:])
        row["parts"] = [
            {**each, "area": each["bbox"][2] * each["bbox"][3], "iscrowd": 0}
            for each in record.to_coco(0, row["categories"])
        ]
    return row


def picture_outcome(
    record: Record,
    opened: PictureLike,
    source: PictureSource,
    options: PictureOptions,
    seconds: float,
    settings: Mapping[str, Any],
) -> PictureOutcome:
    """Make the text, the row, the part of a page and the figures of a record, as the options say."""
    usual = ALL_DRAWINGS if options.out is not None and kind_of(options.out) is None else ()
    drawings = usual if options.draw is None else options.draw
    text = outcome_text(record, source.name, seconds)
    episode = None
    kind = None if options.out is None else kind_of(options.out)
    truth = None if options.annotations is None else read_truth(options.annotations)
    row = _result_row(record, source.name, seconds, kind, source.file, truth)
    if options.report is not None:
        name = Path(source.name).name
        # Others have no more pixels than the record keeps.
        shown = opened if record.how == "windows" else None
        episode = record.page_data(shown, name=name, settings=settings, boxes=source.boxes)
    figures = _draw_episode(record, source.boxes, drawings)
    files = {}
    if options.labels is not None:
        files[str(options.labels / source.place.with_suffix(".txt"))] = record.to_yolo().encode()
    if options.crops is not None:
        picture: Any = source.opened("auto")
        crops = record.crops(picture)
        for number, (crop, label) in enumerate(zip(crops, record.objects.labels.tolist(), strict=True)):
            folder = options.crops / plain_name(record.classes[label]) / source.place.parent
            files[str(folder / f"{source.place.stem}-{number:03d}.jpg")] = jpeg(crop, 92)
    return PictureOutcome(
        ended="looked at" if record.decision is None else record.decision.outcome,
        text=f"{text}\n{looks_text(record)}" if options.looks else text,
        row=row,
        episode=episode,
        names=tuple(figures),
        figures=figures,
        files=files,
    )


def _draw_episode(record: Record, boxes: Tensor | None, drawings: Sequence[Drawing]) -> dict[str, bytes]:
    """Draw those figures and the animation that a record of this kind has; returns the files by name."""
    if not drawings:
        return {}
    figures: dict[str, Callable[[], Any]] = {"scanpath": lambda: record.plot(boxes=boxes)}
    if isinstance(record, Scanpath):
        figures["views"] = lambda: plot_foveated_strip(record)
        if record.target is not None:
            figures["belief"] = lambda: plot_belief(record, None)
            figures["belief_bars"] = lambda: plot_belief_bars(record)
        else:
            figures["map"] = lambda: plot_semantic_map(record)
    names = ["map" if name == "belief" and "map" in figures else name for name in drawings]
    with tempfile.TemporaryDirectory() as folder:
        drawn = [save_figure(figures[name](), Path(folder) / f"{name}.png") for name in names if name in figures]
        if "animation" in drawings:
            film: Any = record.animate(boxes=boxes)
            drawn += film.save(Path(folder) / "animation.gif")
        return {path.name: path.read_bytes() for path in drawn}


def _categories(classes: Sequence[str]) -> list[dict[str, Any]]:
    """Categories of the classes: COCO's own, or numbers from 1 if COCO has not all of them."""
    from semfov.paths.conversion import coco_categories

    categories = coco_categories()
    if {canonical_name(name) for name in classes} <= {canonical_name(each["name"]) for each in categories}:
        return categories
    return [{"id": number, "name": name} for number, name in enumerate(classes, 1)]
