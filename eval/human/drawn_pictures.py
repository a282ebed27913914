"""Pictures that are no photographs: pages, interfaces, charts, drawings and flat pictures, drawn from a seed."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib import font_manager
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

Picture = Image.Image
_Colour = tuple[int, int, int]

_SIZES = ((800, 600), (640, 480), (1280, 800), (1024, 768), (600, 800))
_SYLLABLES = ("ka", "lo", "mi", "tre", "sun", "ver", "ta", "no", "bel", "ri", "ost", "en", "du", "pha", "qui", "sh")
_WHITE = (255, 255, 255)
_INK = (25, 25, 30)


def _font(size: int, family: str = "DejaVu Sans") -> ImageFont.FreeTypeFont:
    """Load a font that comes with Matplotlib, so that pictures are the same on every machine."""
    return ImageFont.truetype(font_manager.findfont(family, fallback_to_default=False), size)


def _size(rng: np.random.Generator) -> tuple[int, int]:
    """Draw the size of a picture."""
    return _SIZES[int(rng.integers(len(_SIZES)))]


def _colour(rng: np.random.Generator, low: int = 0, high: int = 256) -> _Colour:
    """Draw a colour with channels in a range."""
    red, green, blue = (int(value) for value in rng.integers(low, high, 3))
    return red, green, blue


def _words(rng: np.random.Generator, count: int) -> str:
    """Make words of random syllables."""
    words = ("".join(rng.choice(_SYLLABLES, int(rng.integers(1, 5)))) for _ in range(count))
    return " ".join(words)


def _paragraph(
    draw: ImageDraw.ImageDraw,
    rng: np.random.Generator,
    box: tuple[int, int, int, int],
    size: int,
    family: str,
) -> None:
    """Fill a box with lines of text."""
    left, top, right, bottom = box
    font = _font(size, family)
    for y in range(top, bottom - size, round(1.4 * size)):
        line = _words(rng, max(2, (right - left) // (3 * size)))
        while len(line) > 1 and draw.textlength(line, font) > right - left:
            line = line[:-1]
        draw.text((left, y), line, _INK, font)


def text_page(rng: np.random.Generator) -> Picture:
    """Draw a page of a book or paper: a title, and one or two columns of text."""
    width, height = _size(rng)
    page = Image.new("RGB", (width, height), _WHITE if rng.random() < 0.7 else (250, 244, 230))
    draw = ImageDraw.Draw(page)
    margin = round(0.08 * width)
    family = "DejaVu Serif" if rng.random() < 0.6 else "DejaVu Sans"
    draw.text((margin, margin // 2), _words(rng, 4), _INK, _font(int(rng.integers(20, 34)), family))
    columns = int(rng.integers(1, 3))
    column = (width - margin * (columns + 1)) // columns
    size = int(rng.integers(9, 17))
    for number in range(columns):
        left = margin + number * (column + margin)
        _paragraph(draw, rng, (left, margin + 30, left + column, height - margin // 2), size, family)
    return page


def web_page(rng: np.random.Generator) -> Picture:
    """Draw a web page: a bar with a menu, a coloured banner, and cards with text."""
    width, height = _size(rng)
    page = Image.new("RGB", (width, height), _WHITE)
    draw = ImageDraw.Draw(page)
    bar = round(0.09 * height)
    draw.rectangle((0, 0, width, bar), fill=_colour(rng, 20, 120))
    for number in range(4):
        draw.text((20 + number * width // 6, bar // 3), _words(rng, 1), _WHITE, _font(bar // 3))
    banner = bar + round(height * rng.uniform(0.2, 0.4))
    draw.rectangle((0, bar, width, banner), fill=_colour(rng, 150, 250))
    draw.text((width // 12, bar + (banner - bar) // 3), _words(rng, 3), _INK, _font(max(18, (banner - bar) // 6)))
    cards = int(rng.integers(2, 5))
    card_width = width // cards
    for number in range(cards):
        left = number * card_width
        _card(draw, rng, (left + 12, banner + 15, left + card_width - 12, height - 15))
    return page


def _card(draw: ImageDraw.ImageDraw, rng: np.random.Generator, box: tuple[int, int, int, int]) -> None:
    """Draw a card with a coloured picture in its upper third, and text below."""
    left, top, right, bottom = box
    third = top + (bottom - top) // 3
    draw.rounded_rectangle(box, 8, outline=(200, 200, 205), fill=(248, 248, 250))
    draw.rectangle((left + 8, top + 8, right - 8, third), fill=_colour(rng, 60))
    place = (left + 10, third + 12, right - 10, bottom - 10)
    _paragraph(draw, rng, place, int(rng.integers(9, 14)), "DejaVu Sans")


def interface(rng: np.random.Generator) -> Picture:
    """Draw a program's window: a side bar, a table, buttons and fields, light or dark."""
    width, height = _size(rng)
    is_dark = rng.random() < 0.4
    ground: _Colour = (32, 34, 40) if is_dark else (240, 241, 244)
    ink: _Colour = (220, 220, 225) if is_dark else _INK
    window = Image.new("RGB", (width, height), ground)
    draw = ImageDraw.Draw(window)
    side = round(width * rng.uniform(0.15, 0.28))
    draw.rectangle((0, 0, side, height), fill=_colour(rng, 30, 110))
    for number in range(int(rng.integers(5, 12))):
        draw.text((14, 20 + number * 32), _words(rng, 1), (235, 235, 235), _font(13))
    _cells_of_table(draw, rng, (side, 90, width, height - 80), ink)
    _buttons(draw, rng, side + 20, ink)
    draw.rounded_rectangle((side + 20, height - 60, width - 30, height - 20), 5, outline=(150, 150, 160))
    return window


def _cells_of_table(
    draw: ImageDraw.ImageDraw, rng: np.random.Generator, box: tuple[int, int, int, int], ink: _Colour
) -> None:
    """Draw rows of words with lines between them, from the left of a box to the right border of the window."""
    left, top, width, bottom = box
    row_height = int(rng.integers(22, 34))
    for y in range(top, bottom, row_height):
        draw.line((left + 15, y, width - 15, y), fill=(128, 130, 140))
        for x in range(left + 20, width - 60, max(90, width // 7)):
            draw.text((x, y + 5), _words(rng, 1)[:10], ink, _font(12))


def _buttons(draw: ImageDraw.ImageDraw, rng: np.random.Generator, left: int, ink: _Colour) -> None:
    """Draw three buttons, the first of which is filled."""
    accent = _colour(rng, 40, 220)
    for number in range(3):
        is_filled = number == 0
        x = left + number * 130
        draw.rounded_rectangle((x, 25, x + 110, 60), 6, fill=accent if is_filled else None, outline=accent)
        draw.text((x + 14, 34), _words(rng, 1)[:9], _WHITE if is_filled else ink, _font(13))


def chart(rng: np.random.Generator) -> Picture:
    """Draw a chart with Matplotlib: lines, bars, points or a pie."""
    width, height = _size(rng)
    figure = Figure(figsize=(width / 100, height / 100), dpi=100)
    axes = figure.add_subplot()
    kind = int(rng.integers(4))
    if kind == 0:
        axes.plot(rng.normal(size=(40, int(rng.integers(1, 6)))).cumsum(0))
    elif kind == 1:
        axes.bar([*range(8)], rng.uniform(1, 9, 8), color=rng.uniform(size=(8, 3)))
    elif kind == 2:
        x, y = rng.normal(size=(2, 150))
        axes.scatter(x, y, s=rng.uniform(5, 90, 150), c=rng.uniform(size=150))
    else:
        axes.pie(rng.uniform(1, 5, 6))
    axes.set_title(_words(rng, 4))
    axes.set_xlabel(_words(rng, 2))
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return Image.open(content, formats=("PNG",)).convert("RGB")


def line_drawing(rng: np.random.Generator) -> Picture:
    """Draw lines, arcs and outlines in ink on white, half of the pictures in black and white alone."""
    width, height = _size(rng)
    drawing = Image.new("RGB", (width, height), _WHITE)
    draw = ImageDraw.Draw(drawing)
    for _ in range(int(rng.integers(15, 60))):
        x1, x2 = sorted(rng.integers(0, width, 2).tolist())
        y1, y2 = sorted(rng.integers(0, height, 2).tolist())
        thick = int(rng.integers(1, 5))
        kind = int(rng.integers(4))
        if kind == 0:
            draw.line((x1, y1, x2, y2), _INK, thick)
        elif kind == 1:
            draw.ellipse((x1, y1, x2, y2), outline=_INK, width=thick)
        elif kind == 2:
            draw.rectangle((x1, y1, x2, y2), outline=_INK, width=thick)
        else:
            points = np.array([x1, y1]) + rng.normal(0, min(width, height) / 25, (30, 2)).cumsum(0)
            draw.line([(float(x), float(y)) for x, y in points], _INK, thick, joint="curve")
    return drawing.convert("1").convert("RGB") if rng.random() < 0.5 else drawing


def flat_picture(rng: np.random.Generator) -> Picture:
    """Draw a card of one colour, a slope between two colours, or a few flat shapes."""
    width, height = _size(rng)
    kind = int(rng.integers(3))
    if kind == 0:
        return Image.new("RGB", (width, height), _colour(rng))
    if kind == 1:
        first, second = np.array(_colour(rng)), np.array(_colour(rng))
        share = np.linspace(0, 1, width)[None, :, None]
        row = first + (second - first) * share
        return Image.fromarray(np.broadcast_to(row, (height, width, 3)).astype(np.uint8))
    card = Image.new("RGB", (width, height), _colour(rng))
    draw = ImageDraw.Draw(card)
    for _ in range(int(rng.integers(2, 7))):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        radius = int(rng.integers(20, 200))
        draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=_colour(rng))
    return card


KINDS: dict[str, Callable[[np.random.Generator], Picture]] = {
    "pages of text": text_page,
    "web pages": web_page,
    "interfaces": interface,
    "charts": chart,
    "line drawings": line_drawing,
    "flat pictures": flat_picture,
}
"""What is drawn, by name."""


def web_page_with_photograph(rng: np.random.Generator, photographs: Sequence[Path]) -> Picture:
    """Draw a web page whose banner is a photograph.

    Args:
        rng: generator of all that is drawn.
        photographs: files to draw one from.

    Returns:
        The page; a fifth to two fifths of it is the photograph.
    """
    page = web_page(rng)
    width, height = page.size
    bar = round(0.09 * height)
    with Image.open(photographs[int(rng.integers(len(photographs)))], formats=("JPEG", "PNG")) as photograph:
        banner = (width, round(height * rng.uniform(0.2, 0.4)))
        page.paste(photograph.convert("RGB").resize(banner), (0, bar))
    return page
