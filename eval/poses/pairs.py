"""Pairs of frames whose motion is hard to tell: two views of photographs, and what spoils one of them or both.

Where a camera was is known of each view. Some pairs have more frames before them, as a film has.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.motion import Motion

Pixels = NDArray[np.uint8]
Bend = Callable[[Tensor], Tensor]


class View(NamedTuple):
    """A frame, and where the camera was.

    Attributes:
        pixels: `(h, w, 3)` bytes.
        pose: the map from the scene to a frame without distortion; None where nothing tells it.
        scene: number of the scene; views of two scenes have no motion between them.
        bend: the map from pixels `(n, 2)` without distortion to those of the frame, as a rolling shutter bends them.
    """

    pixels: Pixels
    pose: Motion | None
    scene: int = 0
    bend: Bend | None = None


class Stage:
    """Photographs, and random views of them.

    Args:
        pictures: photographs, `(h, w, 3)` bytes.
        seed: seed of all that is random.
    """

    def __init__(self, pictures: Sequence[Pixels], seed: int) -> None:
        self.pictures = pictures
        self.random = np.random.default_rng(seed)

    def picture(self) -> Pixels:
        """Draw a photograph."""
        return self.pictures[int(self.random.integers(len(self.pictures)))]

    def others(self) -> tuple[Pixels, Pixels]:
        """Draw two photographs."""
        first, second = self.random.choice(len(self.pictures), 2, replace=False)
        return self.pictures[first], self.pictures[second]

    def number(self, low: float, high: float) -> float:
        """Draw a number."""
        return float(self.random.uniform(low, high))

    def sign(self) -> float:
        """Draw −1 or 1."""
        return float(self.random.choice([-1, 1]))

    def shift(self, low: float, high: float) -> NDArray[np.float64]:
        """Draw a shift `(x, y)` of a length between two, in a random direction."""
        angle = self.number(0, 2 * np.pi)
        return self.number(low, high) * np.array([np.cos(angle), np.sin(angle)])

    def noise(self, pixels: Pixels, deviation: float) -> Pixels:
        """Add noise of a sensor."""
        return as_bytes(pixels + self.random.normal(0, deviation, pixels.shape))


class Shot:
    """A camera over a photograph, whose views are half as long as the photograph.

    Args:
        stage: photographs and random numbers.
        picture: the photograph; None draws one.
        size: `(width, height)` of the views; None for half of the photograph.
        scene: number of the scene.
    """

    def __init__(
        self, stage: Stage, picture: Pixels | None = None, size: tuple[int, int] | None = None, scene: int = 0
    ) -> None:
        self.stage = stage
        self.picture = stage.picture() if picture is None else picture
        height, width = self.picture.shape[:2]
        self.size = (width // 2, height // 2) if size is None else size
        self.scene = scene
        self.start = np.array([width, height]) * [stage.number(0.4, 0.6), stage.number(0.4, 0.6)]
        self.unit = self.size[0] / 1920  # lengths of kinds are in pixels of a frame 1920 pixels wide

    def view(
        self, shift: NDArray[np.float64] | tuple[float, float] = (0, 0), turn: float = 0.0, scale: float = 1.0
    ) -> View:
        """Take the view of a camera that is shifted by pixels of a frame 1920 pixels wide, turned, and nearer."""
        place = self.start + np.asarray(shift) * self.unit
        matrix = cv2.getRotationMatrix2D((float(place[0]), float(place[1])), turn, scale)
        matrix[:, 2] += np.array(self.size) / 2 - place
        seen = cv2.warpAffine(self.picture, matrix, self.size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        return View(np.asarray(seen, np.uint8), Motion.of(matrix), self.scene)


def as_bytes(values: NDArray[Any]) -> Pixels:
    """Round to bytes."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def changed(view: View, pixels: Pixels) -> View:
    """Replace the pixels of a view."""
    return view._replace(pixels=pixels)


Film = list[View]
Kind = Callable[[Stage], Film]


def cut_to_another_photograph(stage: Stage) -> Film:
    """Cut to another photograph."""
    first, second = stage.others()
    shot = Shot(stage, first)
    after = Shot(stage, second, shot.size, 1)
    return [shot.view(), shot.view((12, 4)), after.view(), after.view((12, 4))]


def cut_to_another_place(stage: Stage) -> Film:
    """Cut to another part of a photograph: the same light, the same colours, the same things."""
    picture = stage.picture()
    height, width = picture.shape[:2]
    first = Shot(stage, picture, (width // 3, height // 3))
    second = Shot(stage, picture, first.size, 1)
    first.start = np.array([width, height]) * [0.25, stage.number(0.25, 0.75)]
    second.start = np.array([width, height]) * [0.75, stage.number(0.25, 0.75)]
    return [first.view(), first.view((8, 0)), second.view(), second.view((8, 0))]


def dissolve(stage: Stage) -> Film:
    """Turn a photograph into another one, at once or in up to 24 frames; what is halfway shows both."""
    first, second = stage.others()
    shot = Shot(stage, first)
    before = shot.view()
    after = Shot(stage, second, shot.size, 1).view()
    film = [before]
    count = int(stage.number(2, 24))
    for number in range(1, count):
        share = number / count
        mixed = as_bytes((1 - share) * before.pixels.astype(np.float64) + share * after.pixels)
        film.append(changed(before if share < 0.5 else after, mixed))
    return [*film, after, after]


def fast_shift(stage: Stage) -> Film:
    """Shift the camera by 150 to 500 pixels."""
    shot = Shot(stage)
    return [shot.view(), shot.view(stage.shift(150, 500))]


def rotation(stage: Stage) -> Film:
    """Turn the camera about its axis by 20 to 180 degrees."""
    shot = Shot(stage)
    return [shot.view(), shot.view(turn=stage.sign() * stage.number(20, 180))]


def zoom(stage: Stage) -> Film:
    """Zoom in or out by a factor of 1.25 to 2.2."""
    shot = Shot(stage)
    factor = stage.number(1.25, 2.2)
    return [shot.view(), shot.view(scale=factor if stage.sign() > 0 else 1 / factor)]


def mirrored(stage: Stage) -> Film:
    """Mirror the second frame."""
    view = Shot(stage).view()
    return [view, View(np.ascontiguousarray(view.pixels[:, ::-1]), None, 1)]


def upside_down(stage: Stage) -> Film:
    """Turn the second frame upside down."""
    shot = Shot(stage)
    return [shot.view(), shot.view(turn=180)]


def repeated_texture(stage: Stage) -> Film:
    """Repeat a piece of a photograph, as in a roof or bricks, no two quite the same, and move it by about a period."""
    picture = stage.picture()
    height, width = picture.shape[:2]
    period = int(width / 3840 * stage.number(40, 160))
    x = int(stage.number(0, width - period - 1))
    y = int(stage.number(0, height - period - 1))
    piece = picture[y : y + period, x : x + period]
    tiled = np.tile(piece, (height // period + 1, width // period + 1, 1))[:height, :width]
    irregular = cv2.GaussianBlur(stage.random.normal(0, 1, (height, width, 1)), (0, 0), period / 4)
    irregular *= stage.number(0, 12) / irregular.std()
    shot = Shot(stage, as_bytes(tiled + irregular[..., None]))
    return [shot.view(), shot.view(stage.shift(0.4, 1.6) * period / shot.unit)]


def row_of_repeats(stage: Stage) -> Film:
    """Repeat stripes along one side alone, as in windows of a facade or parked cars, and move them along it."""
    picture = stage.picture()
    width = picture.shape[1]
    period = int(width / 3840 * stage.number(40, 160))
    x = int(stage.number(0, width - period - 1))
    shot = Shot(stage, np.tile(picture[:, x : x + period], (1, width // period + 1, 1))[:, :width])
    return [shot.view(), shot.view((stage.sign() * stage.number(0.4, 1.6) * period / shot.unit, 0))]


def motion_blur(stage: Stage) -> Film:
    """Blur the second frame along its rows or columns."""
    shot = Shot(stage)
    length = max(3, int(stage.number(20, 120) * shot.unit))
    kernel = np.zeros((length, length), np.float32)
    if stage.sign() > 0:
        kernel[length // 2] = 1 / length
    else:
        kernel[:, length // 2] = 1 / length
    second = shot.view(stage.shift(10, 80))
    return [shot.view(), changed(second, np.asarray(cv2.filter2D(second.pixels, -1, kernel), np.uint8))]


def out_of_focus(stage: Stage) -> Film:
    """Blur the second frame on all sides."""
    shot = Shot(stage)
    second = shot.view(stage.shift(0, 60))
    blurred = cv2.GaussianBlur(second.pixels, (0, 0), stage.number(4, 30) * shot.unit)
    return [shot.view(), changed(second, np.asarray(blurred, np.uint8))]


def darkness(stage: Stage) -> Film:
    """Put out the light, in both frames or in the second one; the camera moves on, and the sensor is noisy."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(10, 80))]
    level = stage.number(0.005, 0.06)
    dark = [changed(view, stage.noise(as_bytes(level * view.pixels.astype(np.float64)), 1.5)) for view in views]
    return dark if stage.sign() > 0 else [views[0], dark[1]]


def faulty_pixels(stage: Stage) -> Film:
    """Darken a scene before a sensor whose bright pixels stay where they are."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(20, 80))]
    pattern = 255.0 * (stage.random.random(views[0].pixels.shape[:2]) < 0.002)
    pattern = cv2.GaussianBlur(pattern, (0, 0), max(0.6, 2 * shot.unit))[..., None] * stage.number(1, 5)
    level = stage.number(0.1, 0.4)
    return [changed(view, as_bytes(level * view.pixels.astype(np.float64) + pattern)) for view in views]


def dirty_lens(stage: Stage) -> Film:
    """Leave dirt or drops on the glass, which stay where they are, and move the scene behind them."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(15, 60))]
    width, height = shot.size
    dirt = np.ones((height, width, 1))
    for _ in range(int(stage.number(10, 60))):
        place = int(stage.number(0, width)), int(stage.number(0, height))
        cv2.circle(dirt, place, max(2, int(stage.number(8, 50) * shot.unit)), stage.number(0.1, 0.6), -1)
    return [changed(view, as_bytes(view.pixels * dirt)) for view in views]


def writing_on_the_frame(stage: Stage) -> Film:
    """Write height and speed on the frames, as a drone does, over a scene that moves."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(15, 60))]
    width, height = shot.size
    scale = stage.number(1, 2.5) * width / 1920
    lines = stage.random.integers(0, 10**9, int(stage.number(2, 10)))
    places = [(int(stage.number(0, 0.8 * width)), int(stage.number(0.05, 0.98) * height)) for _ in lines]
    for view in views:
        for text, place in zip(lines, places, strict=True):
            cv2.putText(view.pixels, f"H {text}", place, 0, scale, (0, 0, 0), max(1, int(5 * scale)))
            cv2.putText(view.pixels, f"H {text}", place, 0, scale, (255, 255, 255), max(1, int(2 * scale)))
    return views


def letterboxed(stage: Stage) -> Film:
    """Put black bars above and below, with a line of writing, and move the scene between them."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(15, 60))]
    bar = int(stage.number(0.1, 0.3) * shot.size[1])
    for view in views:
        view.pixels[:bar] = 0
        view.pixels[-bar:] = 0
        scale = 1.5 * shot.unit
        cv2.putText(view.pixels, "REC 00:41:17 CAM 3 NORTH GATE", (5, bar - 5), 0, scale, (255, 255, 255), 1)
    return views


def lens_flare(stage: Stage) -> Film:
    """Shine a light into the frame that moves otherwise than the scene, and hides part of it."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(10, 60))]
    width, height = shot.size
    rows, columns = np.mgrid[:height, :width]
    centre = np.array([stage.number(0.2, 0.8) * width, stage.number(0.2, 0.8) * height])
    flared = []
    for view in views:
        distance = np.hypot(columns - centre[0], rows - centre[1])
        glow = 400 * np.exp(-distance / (stage.number(0.1, 0.5) * width))
        flared.append(changed(view, as_bytes(view.pixels + glow[..., None])))
        centre = centre + stage.shift(20, 100) * shot.unit
    return flared


def exposure_jump(stage: Stage) -> Film:
    """Make the second frame darker or brighter at once."""
    shot = Shot(stage)
    second = shot.view(stage.shift(0, 60))
    gain = stage.number(0.1, 0.5) if stage.sign() > 0 else stage.number(1.8, 5)
    return [shot.view(), changed(second, as_bytes(gain * second.pixels.astype(np.float64)))]


def _with_lorry(view: View, lorry: Pixels, left: float, share: float) -> View:
    """Let a lorry cover a share of a view's height, from a column on."""
    pixels = view.pixels.copy()
    height, width = pixels.shape[:2]
    high = int(height * share)
    begin = round(left)
    low = max(0, begin)
    end = min(width, begin + lorry.shape[1])
    if end > low:
        pixels[height - high :, low:end] = lorry[:high, low - begin : end - begin]
    return changed(view, pixels)


def _lorry(stage: Stage, size: tuple[int, int], length: float) -> Pixels:
    """Make the side of a lorry: a piece of another photograph, length frames long."""
    picture = stage.picture()
    return np.asarray(cv2.resize(picture, (int(length * size[0]), size[1])), np.uint8)


def lorry_in_both_frames(stage: Stage) -> Film:
    """Let a lorry cover 60 to 90 % of both frames, and move on its own."""
    shot = Shot(stage)
    share = stage.number(0.6, 0.9)
    lorry = _lorry(stage, shot.size, 1.5)
    step = stage.sign() * stage.number(10, 60) * shot.unit
    begin = -0.25 * shot.size[0]
    shift = stage.shift(0, 30)
    return [_with_lorry(shot.view(), lorry, begin, share), _with_lorry(shot.view(shift), lorry, begin + step, share)]


def lorry_that_comes(stage: Stage) -> Film:
    """Let a lorry come, cover 60 to 90 % of the view for some frames, and go; the camera stands or moves."""
    shot = Shot(stage)
    share = stage.number(0.6, 0.9)
    lorry = _lorry(stage, shot.size, 1.2)
    step = stage.number(0.08, 0.25) * shot.size[0]
    camera = stage.shift(0, 1) * stage.random.choice([0, 8, 20])
    count = int(2.4 * shot.size[0] / step) + 2
    views = [shot.view(camera * number) for number in range(count + 2)]
    return [_with_lorry(view, lorry, -1.25 * shot.size[0] + step * number, share) for number, view in enumerate(views)]


def lorry_from_nowhere(stage: Stage) -> Film:
    """Let a lorry cover 60 to 90 % of the second frame alone."""
    shot = Shot(stage)
    second = shot.view(stage.shift(0, 40))
    return [shot.view(), _with_lorry(second, _lorry(stage, shot.size, 1.5), -10, stage.number(0.6, 0.9))]


def parallax(stage: Stage) -> Film:
    """Cover the lower part of the frame by a near plane, which moves by a multiple of what lies behind it."""
    first, second = stage.others()
    shot = Shot(stage, first)
    near = Shot(stage, second, shot.size)
    height = int(stage.number(0.4, 0.8) * shot.size[1])
    shift = stage.shift(15, 60)
    views = []
    for factor in (0.0, 1.0):
        view = shot.view(factor * shift)
        in_front = near.view(stage.number(2, 3) * factor * shift)
        view.pixels[height:] = in_front.pixels[height:]
        views.append(view)
    return views


def rolling_shutter(stage: Stage) -> Film:
    """Read rows one after the other, while the camera shakes or turns."""
    shot = Shot(stage)
    second = shot.view(stage.shift(0, 40))
    width, height = shot.size
    wave = stage.number(0.2, 3) * 2 * np.pi / height
    phase = stage.number(0, 2 * np.pi)
    size = stage.number(3, 60) * shot.unit
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    offset = (size * np.sin(wave * rows + phase)).astype(np.float32)
    bent = cv2.remap(second.pixels, columns - offset, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)

    def bend(points: Tensor) -> Tensor:
        return torch.stack([points[:, 0] + size * torch.sin(wave * points[:, 1] + phase), points[:, 1]], -1)

    return [shot.view(), View(np.asarray(bent, np.uint8), second.pose, bend=bend)]


def interlaced(stage: Stage) -> Film:
    """Take odd rows half a frame later."""
    shot = Shot(stage)
    step = stage.shift(10, 80)
    views = []
    for number in range(2):
        view = shot.view(step * number)
        view.pixels[1::2] = shot.view(step * (number + 0.5)).pixels[1::2]
        views.append(view)
    return views


def compressed(stage: Stage) -> Film:
    """Compress to JPEG of quality 1 to 6, whose blocks stay where they are."""
    shot = Shot(stage)
    quality = int(stage.number(1, 6))
    views = [shot.view(), shot.view(stage.shift(5, 60))]
    coded = [cv2.imencode(".jpg", view.pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])[1] for view in views]
    return [changed(view, np.asarray(cv2.imdecode(code, 1), np.uint8)) for view, code in zip(views, coded, strict=True)]


def coarse_blocks(stage: Stage) -> Film:
    """Reduce frames to large blocks of one colour, as where a link breaks down."""
    shot = Shot(stage)
    views = [shot.view(), shot.view(stage.shift(10, 80))]
    width, height = shot.size
    side = stage.number(16, 60) * shot.unit
    small = max(1, int(width / side)), max(1, int(height / side))
    reduced = [cv2.resize(view.pixels, small, interpolation=cv2.INTER_AREA) for view in views]
    large = [cv2.resize(pixels, shot.size, interpolation=cv2.INTER_NEAREST) for pixels in reduced]
    return [changed(view, np.asarray(pixels, np.uint8)) for view, pixels in zip(views, large, strict=True)]


def water(stage: Stage) -> Film:
    """Show waves, a soft texture that runs and changes its form, while the camera stands still or turns."""
    shot = Shot(stage)
    width, height = shot.size
    step = stage.shift(0, 40)
    views = []
    soft = [cv2.GaussianBlur(stage.random.normal(0, 1, (height, width)), (0, 0), s * shot.unit) for s in (6, 16, 40)]
    later = [cv2.GaussianBlur(stage.random.normal(0, 1, (height, width)), (0, 0), s * shot.unit) for s in (6, 16, 40)]
    drift = [stage.shift(10, 40) * shot.unit for _ in soft]
    form = stage.number(0.3, 0.9)  # share of a wave's form that is new in the second frame
    for number in range(2):
        waves = np.full((height, width), 90.0)
        for begin, end, speed in zip(soft, later, drift, strict=True):
            part = (1 - number * form) * begin / begin.std() + number * form * end / end.std()
            run = np.array([[1, 0, number * speed[0]], [0, 1, number * speed[1]]])
            waves += 12 * cv2.warpAffine(part / part.std(), run, shot.size, borderMode=cv2.BORDER_WRAP)
        view = shot.view(step * number)
        views.append(changed(view, stage.noise(as_bytes(np.repeat(waves[..., None], 3, -1)), 2)))
    return views


def sky(stage: Stage) -> Film:
    """Show a gradient with soft clouds to a camera that turns."""
    shot = Shot(stage)
    height, width = shot.picture.shape[:2]
    size = stage.number(60, 250) * shot.unit
    spots = stage.random.normal(0, 1, (max(2, int(height / size)), max(2, int(width / size))))
    clouds = cv2.resize(spots, (width, height), interpolation=cv2.INTER_CUBIC)
    slope = stage.number(10, 90) * np.linspace(0, 1, height)[:, None]
    values = 150 + slope + stage.number(0, 12) * clouds / clouds.std()
    shot.picture = as_bytes(np.repeat(values[..., None], 3, -1))
    views = [shot.view(), shot.view(stage.shift(20, 120))]
    return [changed(view, stage.noise(view.pixels, stage.number(0, 3))) for view in views]


def noise(stage: Stage) -> Film:
    """Show noise alone."""
    width, height = Shot(stage).size
    frames = [stage.random.integers(0, 255, (height, width, 3), np.uint8) for _ in range(2)]
    return [View(frames[0], None), View(frames[1], None, 1)]


def wall(stage: Stage) -> Film:
    """Show one grey, and another one."""
    width, height = Shot(stage).size
    first = np.full((height, width, 3), int(stage.number(10, 120)), np.uint8)
    return [
        View(stage.noise(first, 2), None),
        View(stage.noise(as_bytes(first + stage.number(10, 100)), 2), None, 1),
    ]


KINDS: dict[str, Kind] = {
    kind.__name__.replace("_", " "): kind
    for kind in (
        cut_to_another_photograph, cut_to_another_place, dissolve, fast_shift, rotation, zoom, mirrored, upside_down,
        repeated_texture, row_of_repeats, motion_blur, out_of_focus, darkness, faulty_pixels, dirty_lens,
        writing_on_the_frame, letterboxed, lens_flare, exposure_jump, lorry_in_both_frames, lorry_that_comes,
        lorry_from_nowhere, parallax, rolling_shutter, interlaced, compressed, coarse_blocks, water, sky, noise, wall,
    )
}  # fmt: skip
"""Kinds of hard pairs, by what the table calls them."""
