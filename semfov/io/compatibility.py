"""Checks that a fitted model may be used together with a detector and a sensor."""

import json
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Protocol

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
# (Some shipped models have `winograd` in place of `runtime`.)
_NOT_COMPARED = {"name", "digest", "background", "winograd", "runtime", "dtype"}

Settings = Mapping[str, Any]
"""Settings of a detector or a sensor as JSON values, by name."""


def searching_for(detector: str) -> str:
    """Name the observation model, fitted for searches, that is shipped for a detector with the `gradual` sensor.

    Args:
        detector: name of the detector.

    Returns:
        The name.
    """
    return f"{detector}-search"


def trained_for(detector: str, growth: float) -> str:
    """Name the observation model, trained for the posterior, that is shipped for a detector with a sensor.

    Args:
        detector: name of the detector.
        growth: of the sensor's blur.

    Returns:
        The name.
    """
    return f"{detector}-sharp" if growth == 1 else detector


def check_classes(fitted: Sequence[str], classes: Sequence[str] | None, what: str) -> None:
    """Check that a model is used with the classes that it was fitted for.

    Args:
        fitted: classes of the fit.
        classes: classes that are used; None if they are not known.
        what: the model, in words.

    Raises:
        InputError: they differ.
    """
    if classes is None:
        return
    expected = f"{len(fitted)} classes, as the {what} was fitted for"
    check(len(classes) == len(fitted), "classes", expected, len(classes))
    for number, (ours, theirs) in enumerate(zip(fitted, classes, strict=True), 1):
        expected = f"{ours!r} as class {number}, as the {what} was fitted with"
        check(ours == theirs, "classes", expected, repr(theirs))


def check_background(fitted: Settings, background: str | None, what: str) -> None:
    """Check that the background policy is that of the scores that a model was fitted on.

    Args:
        fitted: settings of the detector of the fit.
        background: policy that is used; None if it is not known.
        what: the model, in words.

    Raises:
        InputError: it is another one.
    """
    policy = fitted.get("background")
    if policy is None or background is None:
        return
    remedy = f"load the detector with background={policy!r}, or fit a model for {background!r}"
    expected = f"the background policy {policy!r} of the scores that the {what} was fitted on"
    check(policy == background, "background", expected, f"{background!r}; {remedy}")


class _Fitted(Protocol):
    """A fitted model: what it is, in words, and what it says of its fit."""

    title: ClassVar[str]
    metadata: dict[str, Any]


def check_fitted(models: Iterable[_Fitted], settings: Settings, grid: tuple[int, int]) -> None:
    """Check that models were fitted for an eye and for the cells of a belief.

    Args:
        models: the models.
        settings: those of the eye.
        grid: `(columns, rows)` of the belief.

    Raises:
        InputError: one was fitted for another detector, sensor or grid.
    """
    for model in models:
        fitted = model.metadata
        check_same_detector(fitted.get("detector", {}), settings["detector"], model.title)
        check_sensor(fitted.get("sensor", {}), settings["sensor"], model.title, strict=True)
        check_grid(fitted.get("training", {}), grid, model.title)


def check_same_detector(fitted: Settings, detector: Settings, what: str) -> None:
    """Check that a model is used with the detector that it was fitted for; warn where another setting differs.

    Args:
        fitted: settings of the detector of the fit; empty if they are not known.
        detector: settings of the detector that is used; likewise.
        what: the model, in words.

    Raises:
        InputError: the weights or the background policy differ.
    """
    if not detector or not fitted:
        return
    if not _is_same_network(fitted, detector):
        got = _other_network(fitted, detector)
        raise InputError(f"detector: the {what} was fitted for {_described(fitted)}, got {got}")
    check_background(fitted, detector.get("background"), what)
    differences = "; ".join(_differences(fitted, detector, _NOT_COMPARED))
    if differences:
        warnings.warn(f"the {what} was fitted for another detector: {differences}", stacklevel=3)


def _is_same_network(fitted: Settings, detector: Settings) -> bool:
    """Tell whether two detectors have the same network, by their files if both are known, else by their names."""
    ours = fitted.get("digest")
    theirs = detector.get("digest")
    if ours and theirs:
        return bool(ours == theirs or NETWORKS.get(ours, ours) == NETWORKS.get(theirs, theirs))
    return bool(fitted.get("name") == detector.get("name"))


def _described(detector: Settings) -> str:
    """Describe a detector by its name and its file."""
    digest = detector.get("digest")
    file = f" (sha256 {digest[:12]}…)" if digest else ""
    return f"{detector.get('name')!r}{file}"


def _other_network(fitted: Settings, detector: Settings) -> str:
    """Describe a detector with another network than that of the fit, and what to do."""
    if fitted.get("name") != detector.get("name"):
        return f"{_described(detector)}; fit a model for this detector, or use the one it was fitted for"
    network = NETWORKS.get(str(detector.get("digest")))
    if network is None:
        remedy = "give its own file as weights=, or fit models to this one (semfov fit FILE)"
        return f"the file of another network under this name; {remedy}"
    return f"the file of {network!r} under this name; name the detector {network!r}, with this file as weights="


def check_sensor(fitted: Settings, sensor: Settings, what: str, *, strict: bool = False) -> None:
    """Check that the sensor has the settings of the fit; warn where it has not.

    Args:
        fitted: settings of the sensor of the fit; empty if they are not known.
        sensor: settings of the sensor that is used; likewise.
        what: the model, in words.
        strict: whether other settings are an error.

    Raises:
        InputError: settings differ, and the check is strict.
    """
    if not sensor or not fitted:
        return
    differences = "; ".join(_differences(fitted, sensor, set()))
    if not differences:
        return
    if strict:
        remedy = "make the sensor with these settings, or fit a model for this one (semfov fit)"
        expected = f"the sensor that the {what} was fitted for"
        raise InputError(f"eye: expected {expected}, got another: {differences}; {remedy}")
    warnings.warn(f"the {what} was fitted for another sensor: {differences}", stacklevel=3)


def check_grid(fitted: Settings, grid: tuple[int, int], what: str) -> None:
    """Check that a grid has half to twice as many cells along each side as that of the training.

    Args:
        fitted: settings of the training, with its `columns` and `rows` where they are known.
        grid: columns and rows.
        what: the model, in words.

    Raises:
        InputError: it has more or fewer.
    """
    # Evidence has learned how often a cell of one size holds an object and how far the influence of its neighbours
    # reaches.
    columns = fitted.get("columns")
    rows = fitted.get("rows")
    if columns is None or rows is None:
        return
    are_columns_alike = columns / 2 <= grid[0] <= 2 * columns
    are_rows_alike = rows / 2 <= grid[1] <= 2 * rows
    if are_columns_alike and are_rows_alike:
        return
    fit = f"python -m train.fit_search, with --columns {grid[0]} --rows {grid[1]}"
    raise InputError(
        f"grid: the {what} was fitted on {columns} × {rows} cells and is valid for half to twice as many along each "
        f"side, got {grid[0]} × {grid[1]}; use grid={(columns, rows)}, or fit models on such a grid ({fit})"
    )


def _differences(fitted: Settings, used: Settings, exempt: set[str]) -> list[str]:
    """List the settings that differ, in words."""
    differences = []
    for key in sorted((fitted.keys() | used.keys()) - exempt):
        ours = used.get(key)
        theirs = fitted.get(key)
        # As JSON, where lists and tuples look the same.
        if json.dumps(ours, sort_keys=True) != json.dumps(theirs, sort_keys=True):
            differences.append(f"{key} is {ours}, the model was fitted with {theirs}")
    return differences
