"""Checks that a fitted model may be used together with a detector and a sensor."""

import json
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

from semfov.errors import InputError, check

NETWORKS = {
    "695e750a5d5754bb5a8d5325643b59282191a7e7a564e435a415fd3c578eab14": "yolox-nano",
    "c789161ed43c8269fcd4e67c67eeeb4e80c622da2eb296a20bc6007bd18a0b7d": "yolox-nano",
    "f204092ce304306e6d0635eae7112355e7dd59417cef2c50a2ef94f8ec54d56a": "nanodet-plus-m-1.5x",
}
"""Networks that models are shipped for, by the sha256 of their file; the name of the file does not matter.

Files listed under one name are conversions of one checkpoint. YOLOX-nano's were made by Kazuhito00 and by its authors.
NanoDet-Plus's was rebuilt from a copy with weights of 8 bits.
"""


# Keys that other checks compare, and keys of how a network is computed, which changes its numbers only by rounding.
# (Models that were fitted before the key `runtime` existed have `winograd`.)
_ALIKE = {"name", "digest", "background", "winograd", "runtime", "dtype"}


def learned_for(detector: str, growth: float) -> str:
    """Name the learned evidence and maps that are shipped for a detector with a sensor of this growth."""
    return f"{detector}-published" if growth == 1 else detector


def check_classes(fitted: Sequence[str], classes: Sequence[str] | None, what: str) -> None:
    """Raise `InputError` where classes are given and differ from those that the model was fitted for."""
    if classes is not None:
        check(
            len(classes) == len(fitted), "classes", f"{len(fitted)} classes, as the {what} was fitted for", len(classes)
        )
        for place, (mine, theirs) in enumerate(zip(fitted, classes, strict=True), 1):
            check(mine == theirs, "classes", f"{mine!r} as class {place}, as the {what} was fitted with", repr(theirs))


def check_background(fitted: Mapping[str, Any], background: str | None, what: str) -> None:
    """Raise `InputError` where the background policy is not the one that the model was fitted with."""
    policy = fitted.get("background")
    way = f"load the detector with background={policy!r}, or fit a model for {background!r}"
    expected = f"the background policy {policy!r} of the scores that the {what} was fitted on"
    check(background is None or policy in (None, background), "background", expected, f"{background!r}; {way}")


def check_same_detector(fitted: Mapping[str, Any], detector: Mapping[str, Any], what: str) -> None:
    """Raise `InputError` where the weights or the background policy differ; warn where another setting differs."""
    if not detector or not fitted:
        return
    mine, theirs = fitted.get("digest"), detector.get("digest")
    same = fitted.get("name") == detector.get("name")
    if mine and theirs:
        same = mine == theirs or NETWORKS.get(mine, mine) == NETWORKS.get(theirs, theirs)
    if not same:
        own, got = (
            f"{each.get('name')!r}" + (f" (sha256 {each['digest'][:12]}…)" if each.get("digest") else "")
            for each in (fitted, detector)
        )
        remedy = "fit a model for this detector, or use the one it was fitted for"
        if fitted.get("name") == detector.get("name"):
            known = NETWORKS.get(str(theirs))
            got = f"the file of {'another network' if known is None else repr(known)} under this name"
            remedy = f"name the detector {known!r}, with this file as weights="
            if known is None:
                remedy = "give its own file as weights=, or fit models to this one (semfov fit FILE)"
        raise InputError(f"detector: the {what} was fitted for {own}, got {got}; {remedy}")
    check_background(fitted, detector.get("background"), what)
    others = _others(fitted, detector, _ALIKE)
    if others:
        warnings.warn(f"the {what} was fitted for another detector: {'; '.join(others)}", stacklevel=3)


def check_sensor(fitted: Mapping[str, Any], sensor: Mapping[str, Any], what: str, *, strict: bool = False) -> None:
    """Warn, or raise if it is strict, where the sensor has other settings than in the fit; empty ones are unknown."""
    others = _others(fitted, sensor, set()) if sensor and fitted else []
    way = "make the sensor with these settings, or fit a model for this one (semfov fit)"
    same = not (others and strict)
    check(same, "eye", f"the sensor that the {what} was fitted for", f"another: {'; '.join(others)}; {way}")
    if others:
        warnings.warn(f"the {what} was fitted for another sensor: {'; '.join(others)}", stacklevel=3)


def check_grid(fitted: Mapping[str, Any], grid: tuple[int, int], what: str) -> None:
    """Check that a grid `(columns, rows)` has half to twice as many cells along each side as that of the training."""
    # Evidence has learned how often a cell of one size holds an object and how far the influence of its neighbours
    # reaches.
    cells = fitted.get("columns"), fitted.get("rows")
    if None not in cells and not all(n / 2 <= side <= 2 * n for n, side in zip(cells, grid, strict=True)):  # type: ignore[operator]
        raise InputError(
            f"grid: the {what} was fitted on {cells[0]} × {cells[1]} cells and is valid for half to twice as many "
            f"along each side, got {grid[0]} × {grid[1]}; use grid={cells}, or fit models on such a grid (python -m "
            f"train.fit_search and train.fit_map, with --columns {grid[0]} --rows {grid[1]})"
        )


def _others(fitted: Mapping[str, Any], used: Mapping[str, Any], exempt: set[str]) -> list[str]:
    """The settings that differ, in words."""
    return [
        f"{key} is {used.get(key)}, the model was fitted with {fitted.get(key)}"
        for key in sorted((fitted.keys() | used.keys()) - exempt)
        # As JSON, where lists and tuples look the same.
        if json.dumps(fitted.get(key), sort_keys=True) != json.dumps(used.get(key), sort_keys=True)
    ]
