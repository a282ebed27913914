"""The motion of a camera over a scene that is known: estimated within a pixel, or not at all."""

import cv2
import numpy as np
import pytest
import torch

from semfov.motion import CameraMotion, CameraStep, Motion
from semfov.motion.agreement import blocks_of_rival
from semfov.motion.frames import GreyFrame, reduced_grey
from semfov.motion.residual import coarse_shift, share_off, whole_shift

WIDTH, HEIGHT = 640, 360
CENTRE = np.array([WIDTH / 2, HEIGHT / 2])


def scene(seed=0, side=1600):
    """Random patches of many sizes, as a ground seen from above has."""
    random, picture = np.random.default_rng(seed), np.full((side, side, 3), 120, np.uint8)
    for size in (200, 80, 40, 20, 10):
        for _ in range(3 * (side // size) ** 2 // 4):
            x, y = random.integers(0, side, 2)
            colour = random.integers(0, 255, 3).tolist()
            cv2.rectangle(
                picture, (int(x), int(y)), (int(x + random.integers(4, size)), int(y + size // 2)), colour, -1
            )
    return cv2.GaussianBlur(picture, (5, 5), 1)


def view(picture, x, y, turn=0.0, scale=1.0):
    """A frame about a place of the scene, and the map from the scene to the frame."""
    matrix = cv2.getRotationMatrix2D((x, y), turn, scale)
    matrix[:, 2] += CENTRE - (x, y)
    frame = cv2.warpAffine(picture, matrix, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR)
    return frame, Motion.of(matrix)


def error(motion, before, after):
    """Distance in pixels between where a motion takes points of a frame and where they are."""
    places = torch.tensor([[100.0, 60.0], [500.0, 80.0], [320.0, 180.0], [120.0, 300.0], [560.0, 310.0]])
    truth = before.inverse().then(after)
    return float((motion.points(places) - truth.points(places)).norm(dim=-1).max())


FLIGHTS = {
    "shift": lambda k: (600 + 9 * k, 700 + 5 * k),
    "fast": lambda k: (400 + 40 * k, 800),
    "turn": lambda k: (800, 800, 1.5 * k),
    "zoom": lambda k: (800, 800, 0.0, 1.02**k),
    "shake": lambda k: (800 + 6 * (-1) ** k, 800 + 4 * (-1) ** (k // 2)),
}


@pytest.mark.parametrize("flight", FLIGHTS)
def test_motions_add_up_to_where_the_camera_is(flight):
    """Twenty frames: each step is right, and so is their sum."""
    picture, camera = scene(), CameraMotion()
    total = Motion.still()
    frame, first = view(picture, *FLIGHTS[flight](0))
    assert camera.step(frame) == CameraStep(None)
    for number in range(1, 20):
        frame, now = view(picture, *FLIGHTS[flight](number))
        step = camera.step(frame)
        assert step.motion is not None
        total = total.then(step.motion)
        assert error(total, first, now) < 1.0


def test_a_camera_that_stands_still_has_not_moved_at_all():
    """Noise of the sensor is no motion."""
    picture, camera, random = scene(), CameraMotion(), np.random.default_rng(1)
    frame, _ = view(picture, 700, 700)
    camera.step(frame)
    for _ in range(5):
        noisy = np.clip(frame + random.normal(0, 3, frame.shape), 0, 255).astype(np.uint8)
        assert camera.step(noisy).is_still


def test_a_frame_without_texture_stands_still_as_long_as_it_is_the_same():
    """A wall, and the dark: nothing can be followed, and noise may hide a motion."""
    camera, random = CameraMotion(), np.random.default_rng(1)
    wall = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)
    camera.step(wall)
    for _ in range(3):
        assert camera.step(wall).is_still
    noisy = np.clip(wall + random.normal(0, 3, wall.shape), 0, 255).astype(np.uint8)
    assert camera.step(noisy).motion is None
    assert camera.step(np.full_like(wall, 30)).motion is None
    passing = wall.copy()
    passing[100:250, 200:400] = 250
    camera.step(wall)
    assert camera.step(passing).motion is None
    assert camera.step(passing).is_still


def test_a_key_frame_that_no_longer_fits_is_replaced_also_while_the_camera_stands():
    """Things in the scene are exchanged one after the other; then the camera moves on."""
    picture, other = scene(), scene(9)
    camera = CameraMotion()
    for rows in range(0, 4):
        mixed = picture.copy()
        mixed[: 700 + 40 * rows] = other[: 700 + 40 * rows]
        before = view(mixed, 800, 800)
        camera.step(before[0])
    after = view(mixed, 806, 804)
    step = camera.step(after[0])
    assert step.motion is not None
    assert error(step.motion, before[1], after[1]) < 1.0


def test_a_slow_drift_is_not_lost_to_rounding():
    picture, camera = scene(), CameraMotion()
    frame, first = view(picture, 700, 700)
    camera.step(frame)
    total = Motion.still()
    for number in range(1, 31):
        frame, now = view(picture, 700 + 0.1 * number, 700)
        step = camera.step(frame)
        assert step.motion is not None
        total = total.then(step.motion)
    assert error(total, first, now) < 0.6


DISTURBED = {
    "another scene": lambda frame: view(scene(9), 800, 800)[0],
    "a mirrored frame": lambda frame: frame[:, ::-1].copy(),
    "darkness": lambda frame: np.zeros_like(frame),
    "noise": lambda frame: np.random.default_rng(0).integers(0, 255, frame.shape, np.uint8),
    "a grey wall": lambda frame: np.full_like(frame, 128),
    "an upside-down frame": lambda frame: frame[::-1, ::-1].copy(),
    "a leap": lambda frame: cv2.resize(frame[120:240, 213:427], (WIDTH, HEIGHT)),
}


@pytest.mark.parametrize("disturbance", DISTURBED)
def test_frames_that_do_not_fit_together_have_no_motion(disturbance):
    frame, _ = view(scene(), 700, 700)
    camera = CameraMotion()
    camera.step(frame)
    assert camera.step(DISTURBED[disturbance](frame)).motion is None


def test_frames_after_a_disturbance_are_found_again():
    """The motion is that since the last frame before it."""
    picture, camera = scene(), CameraMotion(patience=4)
    frame, before = view(picture, 700, 700)
    camera.step(frame)
    dark = np.zeros_like(frame)
    steps = [camera.step(dark) for _ in range(2)]
    assert [step.motion is None for step in steps] == [True, False]  # nothing moves in the dark
    assert all(step.waits for step in steps)
    frame, after = view(picture, 712, 705)
    step = camera.step(frame)
    assert step.motion is None
    assert not step.waits
    assert error(step.recovered, before, after) < 1.0
    frame, later = view(picture, 720, 708)
    step = camera.step(frame)
    assert error(step.motion, after, later) < 1.0


def test_a_disturbance_that_lasts_ends_the_wait():
    picture, camera = scene(), CameraMotion(patience=3)
    frame, _ = view(picture, 700, 700)
    other = scene(9)
    camera.step(frame)
    steps = [camera.step(view(other, 600 + 5 * number, 600)[0]) for number in range(4)]
    assert [step.waits for step in steps] == [True, True, False, False]
    assert [step.recovered for step in steps] == [None] * 4
    assert [step.motion is None for step in steps] == [
        True,
        False,
        False,
        False,
    ]
    assert [step.gives_up for step in steps] == [False, False, True, False]


def test_a_frame_that_gives_up_is_not_still_though_the_camera_stands():
    camera = CameraMotion(patience=3)
    camera.step(view(scene(), 700, 700)[0])
    other = view(scene(9), 600, 600)[0]
    steps = [camera.step(other) for _ in range(4)]
    assert [step.motion is not None and step.motion.is_still for step in steps] == [False, True, True, True]
    assert [step.is_still for step in steps] == [False, True, False, True]


def blinds():
    return np.repeat(np.where(np.arange(HEIGHT) % 24 < 9, 90, 200), WIDTH).reshape(HEIGHT, WIDTH)


def grid():
    return np.where(np.arange(WIDTH) % 32 < 5, 60, blinds())


def dots():
    across, down = np.meshgrid(np.arange(WIDTH) % 24 - 12, np.arange(HEIGHT) % 24 - 12)
    return np.where(np.hypot(across, down) <= 6, 220, 120)


@pytest.mark.parametrize("pattern", [blinds, grid, dots])
@pytest.mark.parametrize("noise", [2, 5])
@pytest.mark.parametrize("something_else", [False, True])
def test_a_camera_that_stands_before_a_pattern_has_not_moved(pattern, noise, something_else):
    frame = np.repeat(pattern()[..., None], 3, 2).astype(np.uint8)
    if something_else:
        frame[100:300, 250:350] = scene()[:200, :100]
    camera, random = CameraMotion(), np.random.default_rng(1)
    frames = np.clip(frame + random.normal(0, noise, (4, *frame.shape)), 0, 255).astype(np.uint8)
    camera.step(frames[0])
    assert all(camera.step(noisy).is_still for noisy in frames[1:])


@pytest.mark.parametrize("pattern", [blinds, grid, dots])
def test_a_camera_that_drifts_before_a_pattern_is_not_taken_to_stand(pattern):
    """One pixel a frame, until it is a third of a period away."""
    frame, camera = np.repeat(pattern()[..., None], 3, 2).astype(np.uint8), CameraMotion()
    steps = [camera.step(np.roll(frame, (number, number), (0, 1))) for number in range(9)]
    assert not all(step.is_still for step in steps[1:])


def test_noise_of_a_camera_that_stands_does_not_add_up():
    """It stands beside the key frame by less than a pixel for a while, and then zooms."""
    picture, camera = scene(), CameraMotion()
    camera.step(view(picture, 800, 800)[0])
    beside, _ = view(picture, 800.2, 800.15)
    assert all(camera.step(beside).is_still for _ in range(100))
    for number in range(1, 13):
        assert camera.step(view(picture, 800.2, 800.15, 0.0, 1.06**number)[0]).motion is not None


@pytest.mark.parametrize("move", [(0.1, 0), (0.05, -0.08), (45, 20)], ids=["drift", "slow drift", "leap"])
def test_a_camera_that_has_stood_is_seen_to_move(move):
    """It stands for six frames, moves for twelve, and stands again, before a soft scene; the sensor is noisy."""
    picture, camera, random = cv2.GaussianBlur(scene(), (0, 0), 4), CameraMotion(), np.random.default_rng(3)
    steps = np.concatenate([np.zeros(6), np.arange(13), np.full(4, 12)])
    places = np.array([700, 800]) + steps[:, None] * move
    views = [view(picture, *place) for place in places]
    total = Motion.still()
    for frame, _ in views:
        noisy = np.clip(frame + random.normal(0, 3, frame.shape), 0, 255).astype(np.uint8)
        motion = camera.step(noisy).motion
        total = total if motion is None else total.then(motion)
    assert error(total, views[0][1], views[-1][1]) < 1.0


def test_what_passes_before_a_camera_that_stands_is_no_motion_of_the_camera():
    background, patch = view(scene(), 800, 800)[0], scene(seed=5)[:80, :80]
    camera = CameraMotion()
    for number in range(20):
        frame = background.copy()
        frame[140:220, 10 + 20 * number : 90 + 20 * number] = patch
        step = camera.step(frame)
        assert number == 0 or step.is_still


@pytest.mark.parametrize("size", [(480, 7), (7, 480), (2, 2), (1, 1)])
def test_frames_of_some_pixels_across_have_no_slopes_that_tell(size):
    frame = GreyFrame(cv2, np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8))
    assert coarse_shift(cv2, frame, frame, np.eye(3)[:2]) == np.inf
    assert share_off(cv2, frame, frame, np.eye(3)[:2]) == 0
    assert whole_shift(cv2, frame, frame) == 0


@pytest.mark.parametrize(("size", "grey", "fine"), [((1080, 1920), 4, 2), ((700, 1000), 3, 2), ((40, 3000), 7, 4)])
def test_reduced_frames_are_means_of_whole_pixels(size, grey, fine):
    """A rest at the right and below is left out, so that a pixel of the copy is as many of the frame everywhere."""
    pixels = np.random.default_rng(0).integers(0, 255, (*size, 3), np.uint8)
    frame = GreyFrame(cv2, pixels)
    in_colour = reduced_grey(cv2, pixels, 960)
    whole = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY).astype(np.float64)
    for copy, ratio, factor in ((frame.grey, frame.ratio, grey), (*in_colour, fine)):
        rows, columns = (side // factor for side in size)
        assert ratio == (factor, factor)
        blocks = whole[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
        assert np.abs(copy - blocks.mean((1, 3))).max() <= 1


def test_blocks_that_move_otherwise_are_counted():
    """The lower three quarters of a view of 480 × 360 px moved by 4 px, and the two upper rows of blocks by none."""
    picture = scene()
    first, second = picture[200:560, 300:780].copy(), picture[200:560, 296:776].copy()
    second[:90] = first[:90]
    before, after = GreyFrame(cv2, first), GreyFrame(cv2, second)
    shifted = np.array([[1.0, 0, 4], [0, 1, 0]])
    still = np.eye(3)[:2]
    assert share_off(cv2, before, after, shifted) == pytest.approx(2 / 8, abs=0.06)
    assert share_off(cv2, before, after, still) == pytest.approx(6 / 8, abs=0.06)
    assert share_off(cv2, before, before, still) == 0
    far = np.array([[1.0, 0, 60], [0, 1, 0]])
    count = blocks_of_rival(cv2, before.contrast, after.contrast, far, still)
    assert 0 < count <= 20 + 1
    assert blocks_of_rival(cv2, before.contrast, after.contrast, still, still) == 0


def test_an_unsteady_hand_is_followed_behind_something_near():
    """The camera sways; a near thing of a quarter of the view moves by 0.6 of that, too."""
    picture, patch, camera, lost = scene(), scene(seed=5)[:300, :200], CameraMotion(), 0
    swaying = [(600 + 32 * np.sin(number / 3), 700 + 16 * np.cos(number / 2)) for number in range(16)]
    views = [view(picture, *place) for place in swaying]
    for number, (frame, _) in enumerate(views):
        x, y = (round(220 - 0.6 * (swaying[number][0] - 600)), round(40 - 0.6 * (swaying[number][1] - 700)))
        frame[y : y + 300, x : x + 200] = patch
        motion = camera.step(frame).motion
        lost += motion is None
        assert motion is None or error(motion, views[number - 1][1], views[number][1]) < 1.5
    assert lost <= 4


def soft():
    """A scene without corners, such as clouds: it looks like itself after some pixels, but its slopes tell that."""
    grey = cv2.GaussianBlur(np.random.default_rng(3).normal(0, 1, (HEIGHT, WIDTH)), (0, 0), 12)
    return np.repeat(np.clip(128 + 40 * grey / grey.std(), 0, 255).astype(np.uint8)[..., None], 3, 2)


def passing_before(background, height, width):
    """Two frames of a scene that moves by 6 px and leaves a part of a background, above on the left, that stands."""
    frames = [view(scene(), 700 + 6 * number, 700)[0] for number in range(2)]
    for frame in frames:
        frame[:height, :width] = background[:height, :width]
    return frames


# Blocks are compared in eight rows of ten.
A_ROW, A_COLUMN = HEIGHT // 8, WIDTH // 10


@pytest.mark.parametrize("darkness", [False, True], ids=["at once", "after darkness"])
@pytest.mark.parametrize(("rows", "columns", "is_believed"), [(1, 2, True), (1, 5, True), (2, 10, False)])
def test_a_row_of_blocks_that_are_off_is_the_most_that_a_first_motion_leaves_out(rows, columns, is_believed, darkness):
    """The rest of the frame agrees with one motion, and nothing in the part that stands can be followed."""
    first, second = passing_before(soft(), rows * A_ROW, columns * A_COLUMN)
    camera = CameraMotion()
    camera.step(first)
    if darkness:
        camera.step(np.zeros_like(first))
    step = camera.step(second)
    motion = step.recovered if darkness else step.motion
    assert (motion is not None) == is_believed
    if motion is not None:
        np.testing.assert_allclose(motion.matrix[:2, 2], [-6, 0], atol=0.1)


def bars():
    """Bars of many widths, which have no corners."""
    widths = np.random.default_rng(2).integers(6, 30, 100)
    greys = np.random.default_rng(3).integers(40, 220, 100).astype(np.uint8)
    return np.repeat(np.tile(np.repeat(greys, widths), (1600, 1))[..., None], 3, 2)


@pytest.mark.parametrize(("columns", "is_believed"), [(1, True), (3, False), (6, False)])
def test_blocks_that_go_on_as_before_are_the_scene_behind_what_comes(columns, is_believed):
    """The camera moves by 8 px a frame; then something passes by before all but some blocks of one row.

    One block may go on by chance.
    """
    camera = CameraMotion()
    places = [(700, 700), (708, 700), (716, 700), (724, 700), (762, 720)]
    for number, place in enumerate(places):
        frame, _ = view(scene(), *place)
        behind, _ = view(bars(), 700 + 8 * number, 700)
        part = np.s_[2 * A_ROW : 3 * A_ROW, A_COLUMN : (1 + columns) * A_COLUMN]
        frame[part] = behind[part]
        motion = camera.step(frame).motion
        assert number in (0, 4) or motion is not None
    assert (motion is not None) == is_believed
    if motion is not None:
        np.testing.assert_allclose(motion.matrix[:2, 2], [724 - 762, 700 - 720], atol=0.5)


def waves(shift=(0.0, 0.0), noise=0.0, seed=0):
    """A pattern with periods of 24 and 30 px, by its formula, so that it is anywhere; the sensor is noisy."""
    x, y = np.arange(WIDTH) - shift[0], np.arange(HEIGHT)[:, None] - shift[1]
    grey = 128 + 50 * np.cos(2 * np.pi * x / 24) * np.cos(2 * np.pi * y / 30)
    noisy = grey + np.random.default_rng(seed).normal(0, noise, grey.shape)
    return np.repeat(np.clip(np.rint(noisy), 0, 255).astype(np.uint8)[..., None], 3, 2)


@pytest.mark.parametrize("shift", [(24.2, 0), (-23.8, 0), (0, 30.2), (24.1, 29.9)])
@pytest.mark.parametrize("noise", [0, 3])
def test_a_pattern_that_moved_by_about_a_period_is_not_taken_to_stand(shift, noise):
    """What is a quarter of a pixel away may be a period away as well."""
    camera = CameraMotion()
    camera.step(waves((0, 0), noise, 1))
    assert camera.step(waves(shift, noise, 2)).motion is None


def test_a_camera_that_has_stood_before_a_pattern_may_sway_by_some_tenths_of_a_pixel():
    camera = CameraMotion()
    camera.step(waves((0, 0), 3, 1))
    for number, sway in enumerate((0, 0.15, -0.15, 0.2, 0.1)):
        assert camera.step(waves((sway, 0), 3, 2 + number)).is_still


@pytest.mark.parametrize("noise", [2, 5])
@pytest.mark.parametrize("shift", [(0, 0), (0.2, 0), (0, -0.3), (0.3, 0.4)])
def test_the_shift_of_a_whole_frame_is_that_of_its_pattern(shift, noise):
    """In reduced pixels, of which the frame has half as many. Without noise all periods are rounded alike."""
    first, second = (GreyFrame(cv2, waves(place, noise, number)) for number, place in enumerate([(0, 0), shift]))
    assert whole_shift(cv2, first, second) == pytest.approx(np.hypot(*shift) / 2, rel=0.3, abs=0.006)


def test_stripes_tell_the_shift_across_them_and_a_wall_tells_none():
    rows = 128 + 50 * np.cos(2 * np.pi * (np.arange(HEIGHT)[:, None] - np.array([0, 0.4])) / 24)
    striped = [np.repeat(np.rint(row)[:, None, None], WIDTH, 1).repeat(3, 2).astype(np.uint8) for row in rows.T]
    first, second = (GreyFrame(cv2, frame) for frame in striped)
    assert whole_shift(cv2, first, second) == pytest.approx(0.2, rel=0.25)
    wall = GreyFrame(cv2, np.full((HEIGHT, WIDTH, 3), 90, np.uint8))
    assert whole_shift(cv2, wall, wall) == 0
