"""Annotations in COCO's format whose ids results take, and the average precision against them."""

import contextlib
import io
from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from semfov.data.classes import canonical_name
from semfov.data.coco import read_annotations, warn_of_form
from semfov.errors import DataError, check


class Truth:
    """An annotation file in COCO's format: pictures by the ends of their paths, and categories by their names."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.coco, self.digest = read_annotations(path)
        self._images: dict[str, list[dict[str, Any]]] = defaultdict(list)
        for image in self.coco.imgs.values():
            self._images[_parts(image["file_name"])[-1]].append(image)
        entries = self.coco.dataset["annotations"]
        sizes = [[self.coco.imgs[each["image_id"]][side] for side in ("width", "height")] * 2 for each in entries]
        boxes, limits = torch.tensor([each["bbox"] for each in entries]), torch.tensor(sizes)
        warn_of_form(boxes.view(-1, 4).double(), limits.view(-1, 4).double(), path)

    def image_id(self, name: str, size: tuple[int, int] | None = None) -> int | str:
        """The id of a picture of `(width, height)`; of several of one name that whose folders agree best."""
        parts = _parts(name)

        def agreement(image: dict[str, Any]) -> int:
            own = _parts(image["file_name"])
            pairs = zip(reversed(own), reversed(parts), strict=False)
            return next((count for count, (one, other) in enumerate(pairs) if one != other), min(len(own), len(parts)))

        found = sorted(self._images.get(parts[-1], ()), key=agreement)
        if not found or (len(found) > 1 and agreement(found[-1]) == agreement(found[-2])):
            raise DataError(
                f"annotations {self.path}: expected one image with the file_name of {name}, got {len(found)}"
            )
        wanted = int(found[-1]["width"]), int(found[-1]["height"])
        if size not in (None, wanted):
            raise DataError(
                f"annotations {self.path}: expected {name} to have {wanted[0]} × {wanted[1]} px, got {size[0]} × "
                f"{size[1]}; its boxes are in another frame"
            )
        return found[-1]["id"]

    def categories(self, classes: Collection[str]) -> list[dict[str, Any]]:
        """The categories of the file that are among some classes."""
        names = {canonical_name(name) for name in classes}
        found = [each for each in self.coco.dataset["categories"] if canonical_name(each["name"]) in names]
        own = ", ".join(each["name"] for each in self.coco.dataset["categories"][:5])
        check(bool(found), "annotations", f"some of the classes {', '.join([*classes][:5])} as categories", own)
        return found

    def precision(
        self, results: list[dict[str, Any]], images: Sequence[int | str], categories: Sequence[int]
    ) -> tuple[float, float]:
        """AP and AP50 of results by pycocotools, over some images and categories; -1 where there are no objects."""
        from pycocotools.cocoeval import COCOeval

        with contextlib.redirect_stdout(io.StringIO()):
            found = self.coco.loadRes(results) if results else type(self.coco)()
            judge = COCOeval(self.coco, found, "bbox")
            judge.params.imgIds, judge.params.catIds = sorted(images), sorted(categories)
            judge.evaluate()
            judge.accumulate()
            judge.summarize()
        return float(judge.stats[0]), float(judge.stats[1])


def _parts(name: str) -> tuple[str, ...]:
    """The parts of a path, of Windows or not."""
    return PurePosixPath(name.replace("\\", "/")).parts or (name,)
