"""Fuzz what people bring from outside: tags of TIFFs, numbers of any type, labels, tables, and frames of fixations."""

import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import torch
from numpy.typing import NDArray

from benchmarks.fuzz.images import turned
from benchmarks.fuzz.runner import Case, Draw
from semfov import as_image
from semfov.agents.picture import OpenedPicture
from semfov.data.fixations import Fixations, read_table, suspicions
from semfov.data.large import open_large
from semfov.metrics.episodes import area_under_roc

_KINDS = ("u1", "u2", "i2", "u4", "f4", "f8", "f2")
_WITHOUT_WHITE = ("u1", "u2")


def _quiet(call: Any) -> Any:
    """Return a call whose warnings are not shown; they may say what is unusual."""

    def quietly() -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return call()

    return quietly


def _shown(values: NDArray[Any], white: Any) -> NDArray[np.float64]:
    """Values from black, 0, to white, 1."""
    low, high = white if isinstance(white, tuple) else (0.0, white)
    with np.errstate(over="ignore"):
        return np.clip((values.astype(np.float64) - low) / (high - low), 0, 1)


def tiff_tags(draw: Draw, folder: Path) -> Case:
    """`open_large` and the fovea: the pixels that numpy computes from the tags, the same for both."""
    kind, count = draw.choose(_KINDS, "type"), draw.choose((1, 3, 4, 6), "samples")
    height, width = draw.integer(1, 70, "height"), draw.integer(1, 70, "width")
    most = 255 if kind == "u1" else 65535 if kind == "u2" else 1000
    values = draw.rng.integers(0, most + 1, (height, width, count)).astype(kind)
    alpha = count == 4 and draw.flag("alpha") and kind in _WITHOUT_WHITE
    photometric = draw.choose(("minisblack", "miniswhite") if count == 1 else ("rgb", "minisblack"), "photometric")
    planes = count > 1 and draw.flag("planes")
    bands = tuple(draw.integer(1, count, "band") for _ in range(3)) if count == 6 or draw.flag("bands") else None
    far = bands is not None and draw.integer(0, 9, "far") == 0
    white = draw.choose((most, (most // 4, most // 2 + 1)), "white") if draw.flag("with white") else None
    orientation = draw.choose((1, 1, 1, 3, 6, 8), "orientation") if count in (1, 3) and kind == "u1" else 1
    tags: list[Any] = [(274, "H", 1, orientation, True)] if orientation != 1 else []
    if draw.flag("no data"):
        tags.append((42113, "s", 0, draw.choose(("0", "-9999", "nan", "none", ""), "no data"), True))
    big, order = draw.flag("big"), draw.choose("<>", "order")
    path = folder / "picture.tif"
    tifffile.imwrite(
        path,
        np.moveaxis(values, -1, 0) if planes else values[..., 0] if count == 1 else values,
        photometric=photometric,
        planarconfig=None if count == 1 else "separate" if planes else "contig",
        extrasamples=([2 if alpha else 0] * (count - 3) if photometric == "rgb" and count > 3 else None),
        tile=draw.choose((None, (16, 16), (64, 32)), "tile"),
        compression=draw.choose((None, "zlib", "lzma"), "compression"),
        bigtiff=big,
        byteorder=order,
        extratags=tags,
    )
    alpha = alpha and photometric == "rgb"
    chosen = [band - 1 for band in bands] if bands else [0, 1, 2] if count > 1 else [0, 0, 0]
    usual = _shown(values, most if white is None else white)[..., chosen]
    usual = 1 - usual if photometric == "miniswhite" else usual
    if alpha:
        share = values[..., 3:].astype(np.float64) / most
        usual = usual * share + 1 - share
    expected = turned(usual, orientation)
    given: dict[str, Any] = {"white": white, "bands": (count + 1,) * 3 if far else bands}

    def read() -> tuple[NDArray[Any], NDArray[Any]]:
        picture = open_large(path, **given)
        windows = picture.pixels((0, 0, *picture.size))
        return windows, OpenedPicture.of(path, **given).image(torch.zeros(1))[0].permute(1, 2, 0).numpy()

    def check(both: tuple[NDArray[Any], NDArray[Any]]) -> None:
        windows, fovea = both
        assert np.array_equal(windows, np.rint(fovea * 255).astype(np.uint8))
        if not unread:
            np.testing.assert_allclose(windows / 255, expected, atol=2.01 / 255)

    # Of other types Pillow reads grey whose values are those of 16 bits, or floats up to 1.
    unread = white is None and kind not in _WITHOUT_WHITE
    # Nobody turns those that Pillow does not read.
    unnamed = count == 3 and photometric == "minisblack"
    refused = far or (orientation != 1 and (bands is not None or unnamed or (big and order == ">")))
    return Case(_quiet(read), check, may=refused or unread, must=refused)


def dtypes(draw: Draw, _: Path) -> Case:
    """`as_image`, of arrays and tensors of any type, with and without white."""
    kind = draw.choose(("u1", "u2", "i2", "i4", "i8", "f2", "f4", "f8", "?", "O", "c8"), "type")
    shape = draw.choose(((3, 5, 7), (5, 7, 3), (5, 7), (1, 5, 7), (2, 3, 5, 7)), "shape")
    most = {"u1": 255, "u2": 65535, "?": 1}.get(kind, 1.0 if kind[0] == "f" else 1000)
    values = (draw.rng.random(shape) * most).astype(kind)
    broken = kind[0] == "f" and draw.integer(0, 4, "NaN") == 0
    if broken:
        values.flat[0] = draw.choose((math.nan, math.inf, -math.inf), "NaN")
    white = draw.choose((None, 10, (0.25, 0.75), 1e9, "auto"), "white")
    if kind in ("O", "c8"):
        white = None
    tensor = draw.flag("tensor") and kind != "O"
    source = torch.from_numpy(values) if tensor else values
    known = kind in ("u1", "u2") or kind[0] == "f"
    must = len(shape) == 4 or (white is None and (not known or broken))
    plain = values.astype(np.float64) if kind != "c8" else values.real
    if white == "auto":
        there = plain[np.isfinite(plain)]
        low, high = np.percentile(there, (1, 99))
        white_used: Any = (low, high if high > low else low + 1)
    else:
        white_used = white
    shown = plain / most if white is None else np.nan_to_num(_shown(np.nan_to_num(plain, nan=-1e30), white_used))

    def check(image: torch.Tensor) -> None:
        rgb = shown if shape[0] == 3 else np.moveaxis(shown, -1, 0) if shape == (5, 7, 3) else shown.reshape(1, 5, 7)
        assert image.shape == (3, 5, 7)
        wanted = np.broadcast_to(rgb, (3, 5, 7))
        np.testing.assert_allclose(image.double().numpy(), wanted, atol=2e-3)

    return Case(lambda: as_image(source, white=white), check, may=must, must=must, names=("image",))


def labels(draw: Draw, _: Path) -> Case:
    """`area_under_roc`, with labels of any type and values that are no labels: that of counting pairs."""
    count = draw.integer(2, 12, "count")
    present = draw.rng.random(count) < 0.5
    present[:2] = True, False
    scores = draw.rng.integers(0, 5, count) / 4
    forms: dict[str, Any] = {
        "list": present.tolist(),
        "numbers": [int(each) for each in present],
        "tuple": tuple(present.astype(float).tolist()),
        **{kind: present.astype(kind) for kind in ("?", "u1", "i8", "f2", "f8")},
        "half": torch.from_numpy(present).half(),
        "bytes": torch.from_numpy(present).to(torch.uint8),
        "read-only": np.broadcast_to(present, (count,)),
    }
    wrong: dict[str, Any] = {
        "two": present * 2,
        "minus": np.where(present, 1, -1),
        "nan": np.where(present, 1.0, math.nan),
        "words": ["yes" if each else "no" for each in present],
        "short": present[:-1],
        "none": [None] * count,
        "share": present * 0.5,
    }
    form = draw.choose((*forms, *wrong), "form")
    won = [float(a > b) + 0.5 * float(a == b) for a in scores[present] for b in scores[~present]]

    def check(area: torch.Tensor) -> None:
        assert abs(float(area) - np.mean(won)) < 1e-6

    given: Any = {**forms, **wrong}[form]
    return Case(lambda: area_under_roc(torch.from_numpy(scores), given), check, may=form in wrong, must=form in wrong)


def tables(draw: Draw, folder: Path) -> Case:
    """`read_table`: the numbers that were written, in any encoding and form that programs write; else a `DataError`."""
    separator, decimal = draw.choose(((",", "."), (";", ","), (";", "."), ("\t", ","), ("\t", ".")), "separator")
    encoding = draw.choose(("utf-8", "utf-8-sig", "utf-16", "cp1252"), "encoding")
    names = ["picture", "subject", "x", "y", "width", "height", "duration"]
    rows = np.round(draw.rng.random((draw.integer(1, 6, "rows"), 3)) * [80, 60, 400], 2)
    head = draw.choose((str, str.upper, str.title), "capitals")
    before = draw.choose(("", "", "\n\n", "# a remark\n", f"sep={separator}\n"), "before")
    damage = draw.choose(("none", "none", "word", "nan", "far", "doubled", "more", "negative", "gone"), "damage")
    picture = draw.choose(("a.jpg", "bär.jpg", '"a, b; c.jpg"'), "picture")
    lines = [separator.join(map(head, [*names, *(["x"] if damage == "doubled" else [])]))]
    for number, row in enumerate(rows):
        x, y, duration = (f"{value:.2f}".replace(".", decimal) for value in row)
        if number == len(rows) - 1:
            x = {"word": "left", "nan": "nan", "far": "1e30", "gone": ""}.get(damage, x)
            duration = "-5" if damage == "negative" else duration
        fields = [picture, "ann", x, y, "80", "60", duration, *(["1"] if damage in ("doubled", "more") else [])]
        lines.append(separator.join(fields))
    ends = draw.choose(("\n", "\r\n"), "ends")
    path = folder / "people.csv"
    path.write_bytes((before + "\n".join(lines) + "\n").replace("\n", ends).encode(encoding))

    def check(records: list[Fixations]) -> None:
        (record,) = records
        assert (record.picture, record.subject, record.size) == (picture.strip('"'), "ann", (80, 60))
        assert record.durations is not None
        np.testing.assert_allclose(np.column_stack([record.points, record.durations]), rows, atol=1e-9)

    must = damage != "none"
    return Case(_quiet(lambda: read_table(path)), check, may=must, must=must)


def frames(draw: Draw, folder: Path) -> Case:
    """`read_table` with a unit and an origin gives back the points, and `suspicions` says plain lines of any points."""
    width, height = draw.integer(20, 4000, "width"), draw.integer(20, 4000, "height")
    points = draw.rng.random((draw.integer(1, 40, "count"), 2)) * [width, height] - 0.5
    units = draw.choose(("pixels", "fractions", "degrees"), "unit")
    origin = draw.choose(("top left", "bottom left", "centre", "centre, y up", "middle"), "origin")
    placed = points.copy()
    if origin == "bottom left" and units == "pixels":
        placed[:, 1] = height - 1 - placed[:, 1]
    elif (units, origin) != ("pixels", "top left"):
        placed += 0.5
        placed -= np.array([width, height]) / 2 if origin.startswith("centre") else 0
        placed[:, 1] = height - placed[:, 1] if origin == "bottom left" else placed[:, 1]
        placed[:, 1] *= -1 if origin == "centre, y up" else 1
        placed /= np.array([width, height]) if units == "fractions" else 1
    lines = [f"a.jpg,ann,{x!r},{y!r}" for x, y in placed.tolist()]
    path = folder / "people.csv"
    path.write_text("\n".join(["picture,subject,x,y", *lines]))
    odd = draw.choose((1.0, -1.0, 1e-3, 1e3), "odd")

    def check(records: list[Fixations]) -> None:
        (record,) = records
        np.testing.assert_allclose(record.points, points, atol=1e-6 * max(width, height))
        changed = Fixations("a.jpg", "ann", points * odd, (width, height), np.abs(points[:, 0]) * abs(odd))
        for line in suspicions([record, changed]):
            assert 10 < len(line) < 200
            assert "\n" not in line

    must = units == "degrees" or origin == "middle"
    read = _quiet(lambda: read_table(path, size=(width, height), units=units, origin=origin))
    return Case(read, check, may=must, must=must)
