"""The eye for windows: what it shows, the windows of a lattice, slices, hints of objects, and blank places."""

import math

import numpy as np
import pytest
import tifffile
import torch
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from torch import Tensor

from eval.zoom.orders import adaptive_slices
from semfov import Detector, InputError, Selection, WindowEye, ZoomAgent
from semfov.agents.episode import EpisodeLimits
from semfov.agents.windows import window_eye
from semfov.data.large import open_large
from semfov.detection import Candidates
from semfov.detection.detector import FAINT
from semfov.sensor.glimpse import glimpse, windows_at
from semfov.settings import FindSettings, SearchSettings
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.blank import blank_cells, reaching_border
from semfov.zoom.eye import BORDER, _hints_of
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.lattice import CELLS
from semfov.zoom.looks import LiveWindowLooks, Window
from semfov.zoom.slices import ranked, raw, usual_slices
from tests import small
from tests.data.test_large import pixels
from tests.refusals import refused
from tests.small import Coloured


def test_canvas_is_the_antialiased_glimpse_inside_its_border(detector):
    image = torch.rand(3, 300, 420, generator=torch.Generator().manual_seed(0))
    eye = WindowEye(detector)
    view = eye.open(image)
    fixation = torch.tensor([[199.5, 149.5, 0.64]])
    canvas, frames = eye.glimpse(view, fixation)
    box = windows_at(fixation[:, :2], fixation[:, 2], (128, 128))
    assert frames[0].tolist() == [100, 50, 300, 250, 0, 0, 128, 128]
    expected = glimpse((image * 255).round()[None] / 255, box, (128, 128))
    # Bytes are rounded once on the way.
    assert float((canvas - expected)[..., 3:-3, 3:-3].abs().max()) <= 1.01 / 255


def test_the_whole_picture_equals_a_resize_by_pillow(detector):
    pixels = np.random.default_rng(0).integers(256, size=(384, 512, 3), dtype=np.uint8)
    eye = WindowEye(detector)
    view = eye.open(pixels)
    canvas, _ = eye.glimpse(view, view.lattice.fixations(view.lattice.actions[:1]))
    expected = np.asarray(Image.fromarray(pixels).resize((128, 96), Image.Resampling.BILINEAR))
    got = (canvas[0, :, :96] * 255).permute(1, 2, 0).numpy()
    assert np.abs(got - expected).max() <= 1
    assert float(canvas[0, :, 96:].abs().max()) == 0


@pytest.mark.parametrize("size", [(512, 384), (300, 500), (1200, 310)])
def test_a_stretched_picture_fills_the_canvas_as_a_resize_by_pillow(detector, size):
    """Also one that is read from a reduced copy; boxes are in pixels of the picture."""
    width, height = size
    pixels = np.random.default_rng(0).integers(256, size=(height, width, 3), dtype=np.uint8)
    eye = WindowEye(detector, stretch=True)
    view = eye.open(pixels)
    canvas, frames = eye.glimpse(view, view.lattice.fixations(view.lattice.actions[:1]))
    expected = np.asarray(Image.fromarray(pixels).resize((128, 128), Image.Resampling.BILINEAR))
    assert np.abs((canvas[0] * 255).permute(1, 2, 0).numpy() - expected).max() <= 1
    assert frames.tolist() == [[0, 0, width, height, 0, 0, 128, 128]]
    seen = detector(torch.from_numpy(expected.copy()).permute(2, 0, 1)[None] / 255)
    placed = eye.look(view, view.lattice.fixations(view.lattice.actions[:1]))
    scale = torch.tensor([width, height] * 2) / 128
    torch.testing.assert_close(placed.boxes[placed.mask], seen.boxes[seen.mask] * scale, atol=1e-3, rtol=1e-5)


def test_windows_inside_the_picture_and_long_strips_are_not_stretched(detector):
    for size, fixation, expected in (
        ((400, 300), [199.5, 149.5, 1.0], [136, 86, 264, 214, 0, 0, 128, 128]),
        ((1280, 200), [639.5, 99.5, 0.1], [0, 0, 1280, 200, 0, 54, 128, 74]),
    ):
        eye = WindowEye(detector, stretch=True)
        _, frames = eye.glimpse(eye.open(torch.rand(3, *reversed(size))), torch.tensor([fixation]))
        assert frames[0].tolist() == expected


def test_a_window_that_fills_the_canvas_is_the_same_with_and_without_stretching(monkeypatch):
    """Its edges are rounded to pixels of the reduced copy from which it is read."""
    monkeypatch.setattr("semfov.data.windowed._LARGE", 1 << 15)
    pixels = np.random.default_rng(0).integers(256, size=(1000, 1000, 3), dtype=np.uint8)
    fixation = torch.tensor([[500.0, 500.0, 1 / 11.93]])
    eyes = [WindowEye(small.Fixed(("cup",)), stretch=stretch) for stretch in (False, True)]
    (canvas, frames), (stretched, same_frames) = (eye.resample(eye.open(pixels), fixation) for eye in eyes)
    assert frames == same_frames == [(308, 308, 692, 692, 0, 0, 32, 32)]
    assert torch.equal(canvas, stretched)


def test_windows_are_stretched_as_the_detector_was_trained_or_as_in_the_fit_of_the_evidence(detector):
    assert not WindowEye(detector).stretch
    trained = Coloured(stretch=True)
    assert WindowEye(trained).stretch
    assert WindowEye(trained).settings()["sensor"]["stretch"]
    assert not WindowEye(trained, stretch=False).stretch
    assert window_eye(trained, None).stretch
    for stretch in (True, False):
        eye = WindowEye(trained, stretch=stretch)
        evidence = GlimpseEvidence(2, metadata=eye.settings())
        assert evidence.stretch == stretch
        assert ZoomAgent(eye, evidence).eye is eye
        assert window_eye(trained, evidence).stretch == stretch
        refused(
            f"eye: expected one with stretch={stretch}", ZoomAgent, WindowEye(trained, stretch=not stretch), evidence
        )


@pytest.mark.parametrize("magnification", [0.5, 1.0])
def test_boxes_are_in_pixels_of_the_picture(detector, picture, magnification):
    eye = WindowEye(detector)
    seen = eye.look(eye.open(picture), torch.tensor([[655.5, 335.5, magnification]]))
    red = seen.boxes[0][(seen.labels[0] == 1) & (seen.confidence[0] > 0.02)]
    assert len(red)
    covered = torch.cat([red[:, :2].amin(0), red[:, 2:].amax(0)])
    cell = 16 / magnification
    assert float((covered - torch.tensor([640.0, 320, 672, 352])).abs().max()) <= cell


def test_boxes_cut_by_the_window_are_kept_dropped_or_made_background(detector, picture):
    fixation = torch.tensor([[640.0 - 64 + 8 - 0.5, 335.5, 1.0]])  # its window ends in the red square
    keep, drop, nothing = (WindowEye(detector, cut=cut) for cut in ("keep", "drop", "background"))
    seen = keep.detect(keep.open(picture), fixation)
    assert bool(seen.cut.any())
    dropped = drop.look(drop.open(picture), fixation)
    assert int(dropped.count) == int(seen.detections.count) - int(seen.cut.sum())
    uncut = seen.detections.scores * ~seen.cut[..., None]
    assert torch.equal(dropped.highest, uncut.amax(1))
    background = nothing.look(nothing.open(picture), fixation)
    assert float(background.confidence[seen.cut].max()) == 0
    torch.testing.assert_close(background.boxes, seen.detections.boxes)
    image = torch.zeros(3, 256, 256)
    image[0, :32, :32] = 1
    eye = WindowEye(detector)
    assert not bool(eye.detect(eye.open(image), torch.tensor([[63.5, 63.5, 1.0]])).cut.any())


@pytest.mark.parametrize("fill", [0.0, 114 / 255, 0.5, 0.3])
def test_the_detector_gets_the_glimpse(detector, fill):
    """A padding that is no byte is kept, too."""
    detector.fill = fill
    canvases, propose = [], detector.propose
    detector.propose = lambda canvas: canvases.append(canvas) or propose(canvas)
    eye = WindowEye(detector)
    view = eye.open(torch.rand(3, 300, 420, generator=torch.Generator().manual_seed(0)))
    # Resampled, with padding, native pixels, enlarged.
    fixations = torch.tensor([[199.5, 149.5, 0.64], [0.0, 20.0, 0.5], [199.5, 149.5, 1.0], [30.0, 40.0, 2.0]])
    for some in (fixations, *fixations.split(1)):
        eye.look(view, some)
        canvas, _ = eye.glimpse(view, some)
        assert torch.equal(canvases[-1], canvas)
        assert canvas.is_contiguous()
        assert canvas.shape == (len(some), 3, 128, 128)
        assert 0.7 < float(canvas.max()) <= 1
    assert float(canvases[2][0, 0, 0, 0]) == pytest.approx(fill, abs=1e-7)


def test_windows_beside_the_picture_are_filled_and_show_its_nearest_pixel(detector, picture):
    eye = WindowEye(detector)
    canvas, frames = eye.glimpse(eye.open(picture), torch.tensor([[0.0, 0.0, 1.0]]))
    assert frames[0, :4].tolist() == [0, 0, 64, 64]
    assert float(canvas[0, :, :60, :60].abs().max()) == 0
    image = torch.rand(3, 60, 90, generator=torch.Generator().manual_seed(0))
    eye = WindowEye(detector)
    canvas, frames = eye.glimpse(eye.open(image), torch.tensor([[500.0, 400.0, 1.0], [-500.0, -400.0, 1.0]]))
    assert frames.tolist() == [[89, 59, 90, 60, 0, 0, 1, 1], [0, 0, 1, 1, 127, 127, 128, 128]]
    for number, (place, pixel) in enumerate((((0, 0), (59, 89)), ((127, 127), (0, 0)))):
        expected = torch.full((3, 128, 128), float(detector.fill))
        expected[:, *place] = (image[:, *pixel] * 255).round() / 255
        assert torch.equal(canvas[number], expected)


def test_detections_of_a_batch_equal_those_of_its_looks_one_by_one(detector, picture):
    eye = WindowEye(detector)
    view = eye.open(picture)
    fixations = torch.tensor([[655.5, 335.5, 1.0], [640.0 - 64 + 8 - 0.5, 335.5, 1.0], [511.5, 383.5, 0.125]])
    together = eye.detect(view, fixations)
    counts = set()
    for number in range(3):
        alone = eye.detect(view, fixations[number : number + 1])
        whole, one = together.detections, alone.detections
        found = int(one.count)
        assert found == int(whole.count[number]) > 0
        torch.testing.assert_close(whole.boxes[number, :found], one.boxes[0, :found])
        assert float(whole.boxes[number, found:].abs().sum()) == 0
        counts.add(found)
        assert torch.equal(together.cut[number, :found], alone.cut[0])
        assert not bool(together.cut[number, found:].any())
    assert len(counts) > 1


def test_cut_boxes_are_those_that_reach_the_border_of_the_canvas_inside_the_picture(detector, picture):
    eye = WindowEye(detector)
    view = eye.open(picture)
    fixations = torch.tensor([[640.0 - 64 + 8 - 0.5, 335.5, 1.0], [60.0, 60.0, 1.0], [511.5, 383.5, 0.125]])
    seen = eye.detect(view, fixations)
    _, frames = eye.glimpse(view, fixations)
    wide, high = view.picture.size
    for number, (x1, y1, x2, y2, u1, _, u2, _) in enumerate(frames.tolist()):
        slack = BORDER * (x2 - x1) / (u2 - u1) + 1e-3
        for (a, b, c, d), kept, cut in zip(
            seen.detections.boxes[number].tolist(), seen.detections.mask[number], seen.cut[number], strict=True
        ):
            left, top, right, bottom = x1 and a <= x1 + slack, y1 and b <= y1 + slack, c >= x2 - slack, d >= y2 - slack
            assert bool(cut) == bool(kept and (left or top or (right and x2 < wide) or (bottom and y2 < high)))
    assert 0 < int(seen.cut.sum()) < int(seen.detections.count.sum())


def test_settings_include_the_treatment_of_cut_boxes(detector):
    assert WindowEye(detector).settings() != WindowEye(detector, cut="drop").settings()
    refused("unknown treatment of cut boxes", WindowEye, detector, cut="hide")
    refused("finest: expected a positive", WindowEye, detector, finest=0)
    eye = WindowEye(detector)
    refused("fixations: expected", eye.look, eye.open(torch.zeros(3, 64, 64)), torch.zeros(1, 4))
    refused("fixations: expected finite", eye.look, eye.open(torch.zeros(3, 64, 64)), torch.full((1, 3), torch.nan))
    with pytest.raises(InputError, match="fixations: expected positive magnifications"):
        eye.look(eye.open(torch.zeros(3, 64, 64)), torch.tensor([[3.0, 4.0, -1.0]]))


@pytest.fixture
def agent():
    return ZoomAgent(WindowEye(Coloured()))


def picture(*squares):
    """Squares `(x, y, side, colour)` on grey, 1200 × 900 px."""
    pixels = np.random.default_rng(0).integers(95, 105, (900, 1200, 3), np.uint8)  # not blank
    for x, y, side, colour in squares:
        pixels[y : y + side, x : x + side] = {"red": (230, 25, 25), "green": (25, 230, 25)}[colour]
    return pixels


def test_slices_cover_the_picture(agent):
    lattice = agent.eye.open(picture()).lattice
    covered = np.zeros((900, 1200), bool)
    for window in usual_slices(lattice):
        x1, y1, x2, y2 = (int(edge) for edge in window.within)
        covered[y1:y2, x1:x2] = True
    assert covered.all()


@pytest.mark.parametrize("size", [(3840, 2160), (2160, 3840), (1600, 1201), (1819, 1000), (1818, 1000), (5003, 4999)])
def test_adaptive_slices_are_as_many_as_the_size_asks_and_cover_the_picture(size):
    windows = adaptive_slices(Lattice.over(size, (416, 416)))
    boxes = np.array([window.within for window in windows])
    columns, rows = (np.unique(boxes[:, axis]) for axis in (0, 1))
    across, down = (4, 3) if max(size) > 512 * (4 - 3 * 0.15) + 1 else (3, 2)
    assert len(columns) <= across
    assert len(rows) <= down
    assert len(columns) == across or len(rows) == down
    side = boxes[0, 2] - boxes[0, 0]
    for starts, length in ((columns, size[0]), (rows, size[1])):
        assert starts[0] == 0
        assert starts[-1] + side == max(length, side)
        assert (np.diff(starts) <= side * 0.85 + 1).all()


def test_windows_come_in_the_order_of_the_summed_scores(agent):
    """By a loop over the cells of the overview's hints."""
    source = LiveWindowLooks(agent.eye, agent.eye.open(picture((900, 600, 90, "green"), (100, 100, 60, "red"))))
    windows = usual_slices(source.lattice)
    (overview,) = source.see(
        [path.window for path in agent.find_all(picture(), settings=FindSettings(passes=1)).window_looks]
    )
    hints = overview.gist
    for targets in ([], [1], [2], [1, 2]):
        sums = []
        for window in windows:
            x1, y1, x2, y2 = (edge / hints.scale for edge in window.cells)
            total = 0.0
            for row in range(hints.scores.shape[0]):
                for column in range(hints.scores.shape[1]):
                    if int(x1) <= column < np.ceil(x2) and int(y1) <= row < np.ceil(y2):
                        scores = hints.scores[row, column]
                        total += float(max(scores[[t - 1 for t in targets]] if targets else scores))
            sums.append(total)
        assert [raw(overview, window, targets) for window in windows] == pytest.approx(sums, abs=1e-5)
        order, done, chosen = ranked(windows, targets), set(), []
        while choice := order([overview], done):
            done.add(choice[0][0])
            chosen.append(choice[0][1])
        assert chosen == pytest.approx(sorted(sums, reverse=True), abs=1e-5)


def test_searches_find_or_stay_undecided(agent):
    scene = picture((900, 600, 90, "green"))
    found = agent.search(scene, "green")
    assert found.decision.outcome == "found"
    assert found.ending == "detection"
    x1, y1, x2, y2 = found.decision.box.tolist()
    assert x1 < 945 < x2
    assert y1 < 645 < y2
    missing = agent.search(scene, "red")
    assert (missing.decision.outcome, missing.ending) == ("undecided", "windows")
    assert missing.passes == 1 + len(usual_slices(missing.lattice))


def test_limits_and_several_classes(agent):
    scene = picture((900, 600, 90, "green"), (100, 100, 60, "red"))
    both = agent.find_all(scene, ["red", "green"])
    assert sorted(both.objects.labels.tolist()) == [1, 2]
    assert both.targets == (1, 2)
    assert set(agent.find_all(scene, "red").objects.labels.tolist()) == {1}
    assert agent.find_all(scene, "red", FindSettings(passes=3)).ending == "passes"
    seen = []
    stopped = agent.find_all(
        scene, settings=FindSettings(on_look=lambda record: seen.append(record.passes) or len(seen) < 2)
    )
    assert (stopped.ending, seen, stopped.passes) == ("stopped", [1, 2], 2)
    assert agent.search(picture(), "red", SearchSettings(seconds=0)).ending == "seconds"
    refused("seconds", EpisodeLimits, seconds=-1)
    assert torch.equal(both.candidates.boxes, agent.find_all(scene, [1, 2]).candidates.boxes)


sizes = st.tuples(st.integers(200, 9000), st.integers(200, 9000))


@given(sizes)
def test_windows_tile_the_picture_and_a_single_fixation_equals_its_row_among_all(size):
    lattice = Lattice.over(size, (416, 416))
    wide, high = lattice.pitch
    assert lattice.columns * wide >= size[0] - 0.1 > (lattice.columns - 1) * wide - 0.2
    assert lattice.rows * high >= size[1] - 0.1 > (lattice.rows - 1) * high - 0.2
    for level in range(lattice.levels):
        assert lattice.window(level)[0] == pytest.approx(lattice.span(level) * wide)
    assert lattice.span(lattice.levels - 1) == CELLS
    whole = lattice.boxes(torch.tensor([0, 0, 0]))
    assert whole[2] >= size[0] - 0.5
    assert whole[3] >= size[1] - 0.5
    lattice = Lattice.over(size, (416, 320))
    some = lattice.actions[:: max(len(lattice) // 20, 1)]
    fixations = [lattice.fixation(*action) for action in some.tolist()]
    assert torch.equal(torch.tensor(fixations), lattice.fixations(some))


def test_actions_are_numbered_and_fixations_are_centres_of_boxes():
    lattice = Lattice.over((2560, 1920), (416, 416))
    assert len(lattice.actions) == len(lattice) == 579
    for number in (0, 1, 153, 154, 578):
        assert lattice.number(*lattice.actions[number].tolist()) == number
    lattice = Lattice.over((3840, 2160), (416, 416))
    boxes, fixations = lattice.boxes(lattice.actions), lattice.fixations(lattice.actions)
    torch.testing.assert_close((boxes[:, :2] + boxes[:, 2:]) / 2 - 0.5, fixations[:, :2])
    torch.testing.assert_close(416 / (boxes[:, 2] - boxes[:, 0]), fixations[:, 2])


KINDS = 3


class Given(Detector):
    """Proposes boxes that do not depend on the canvas; most are faint, many lie on each other."""

    def __init__(self, count: int, background: str = "residual", faint: float = FAINT) -> None:
        selection = Selection(threshold=0.02, iou=0.5, limit=20)
        super().__init__("given", ("a", "b", "c"), (128, 128), background=background, selection=selection, faint=faint)
        generator = torch.Generator().manual_seed(count)
        places = torch.rand(count // 4, 2, generator=generator) * 128
        middle = places.repeat(4, 1) + 0.1 * torch.rand(count // 4 * 4, 2, generator=generator)
        half = 2 + 20 * torch.rand(len(middle), 2, generator=generator)
        self.boxes = torch.cat([middle - half, middle + half], -1)
        self.scores = torch.rand(len(middle), KINDS, generator=generator)
        # From about 0.00002 to 1: some of the candidates are too faint for hints.
        self.certain = (-11 * torch.rand(len(middle), generator=generator)).exp()

    def propose(self, canvas: Tensor) -> Candidates:
        size = len(canvas), len(self.boxes)
        return Candidates(self.boxes.expand(*size, 4), self.scores.expand(*size, KINDS), self.certain.expand(*size))


@pytest.mark.parametrize("faint", [FAINT, 0.1])
@pytest.mark.parametrize("count", [40, 2000])
@pytest.mark.parametrize(("column", "row", "level"), [(0, 0, 0), (4, 3, 1), (16, 8, 1)])
def test_a_gist_holds_the_strongest_of_all_candidates_of_each_cell(count, faint, column, row, level):
    detector = Given(count, faint=faint)
    eye = WindowEye(detector)
    view = eye.open(torch.zeros(3, 384, 512))
    lattice = view.lattice
    assert column < lattice.places(level)[0]
    assert row < lattice.places(level)[1]
    window = Window.on(lattice, (level, column, row))
    window_look = LiveWindowLooks(eye, view).see([window])[0]
    look = window_look.gist
    rows, columns, _ = look.scores.shape
    x, y, magnification = window.fixation
    left, top = x + 0.5 - 64 / magnification, y + 0.5 - 64 / magnification
    right, bottom = min(left + 128 / magnification, 512), min(top + 128 / magnification, 384)
    strongest, size = torch.zeros(rows, columns, KINDS), torch.zeros(rows, columns)
    leads, hints = torch.zeros(rows, columns), 0
    for box, scores, certain in zip(detector.boxes, detector.scores, detector.certain, strict=True):
        if float(certain * scores.max()) < faint:
            continue
        confidence = float(certain * scores.max() / scores.sum())
        hints += 1
        x1, y1, x2, y2 = (box / magnification + torch.tensor([left, top, left, top])).tolist()
        x1, x2 = (min(max(each, left), right) for each in (x1, x2))
        y1, y2 = (min(max(each, top), bottom) for each in (y1, y2))
        column_of = min(max(int(((x1 + x2) / 2 - left) // (lattice.pitch[0] * look.scale)), 0), columns - 1)
        row_of = min(max(int(((y1 + y2) / 2 - top) // (lattice.pitch[1] * look.scale)), 0), rows - 1)
        cell = row_of, column_of
        strongest[cell] = torch.maximum(strongest[cell], certain * scores / scores.sum())
        if confidence > leads[cell]:
            leads[cell] = confidence
            wide, high = (max(side * magnification, 1e-3 * magnification) for side in (x2 - x1, y2 - y1))
            size[cell] = max(math.log2(wide * high) / 2, 0.0)
    assert 0 < hints < len(detector.boxes)
    torch.testing.assert_close(look.scores, strongest, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(look.size, size, rtol=0, atol=1e-4)
    torch.testing.assert_close(window_look.show, strongest.amax((0, 1)), rtol=1e-5, atol=1e-7)
    found = window_look.detections.scores[0, :, 1:].amax(-1) >= DETECTION_SCORE
    assert 0 < int(look.found.sum()) <= int(found.sum()) <= 20


def test_looks_of_a_batch_have_their_own_hints():
    class Lit(Given):
        """As many boxes as the canvas is bright."""

        def propose(self, canvas: Tensor) -> Candidates:
            found = super().propose(canvas)
            bright = canvas.mean((1, 2, 3))[:, None]
            rank = torch.arange(len(self.boxes)) / len(self.boxes)
            return Candidates(found.boxes, found.classes, found.objectness * (rank < bright))

    eye = WindowEye(Lit(400))
    picture = torch.linspace(0, 1, 512).expand(3, 384, 512)
    view = eye.open(picture)
    fixations = torch.tensor([[100.0, 100.0, 1.0], [300.0, 200.0, 0.7], [400.0, 300.0, 1.0]])
    together = eye.detect(view, fixations)
    assert len({len(hints.boxes) for hints in together.hints}) == 3
    for number, hints in enumerate(together.hints):
        alone = eye.detect(view, fixations[number : number + 1]).hints[0]
        for name in ("boxes", "scores"):
            assert torch.equal(getattr(hints, name), getattr(alone, name))


def test_a_look_without_hints_shows_its_detections():
    detector = Given(400)
    eye = WindowEye(detector)
    view = eye.open(torch.zeros(3, 384, 512))
    last = view.lattice.levels - 1
    window = Window.on(view.lattice, (last, 3, 3))
    plain, hinted = (LiveWindowLooks(eye, view).see([window], hints=hints)[0] for hints in (False, True))
    assert plain.gist is None
    assert hinted.gist is None
    assert torch.equal(plain.show, plain.detections.scores[0, :, 1:].amax(0))
    every = detector.certain[:, None] * detector.scores / detector.scores.sum(-1, keepdim=True)
    torch.testing.assert_close(hinted.show, every.amax(0))


def test_hints_share_the_scores_of_detections_for_any_background():
    for policy in ("residual", "normalised", "uniform", "none"):
        detector = Given(80, policy)
        eye = WindowEye(detector)
        seen = eye.detect(eye.open(torch.zeros(3, 128, 128)), torch.tensor([[63.5, 63.5, 1.0]]))
        hints, found = seen.hints[0], seen.detections
        same = (found.boxes[0][:, None] == hints.boxes).all(-1)
        assert bool((same.sum(1) == 1).all())
        torch.testing.assert_close(found.scores[0, :, 1:], hints.scores[same.int().argmax(1)])


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_hints_that_are_not_finite_are_refused(value):
    boxes, classes = torch.rand(1, 5, 4), torch.full((1, 5, 2), 0.01)
    boxes[0, 3, 2] = value
    with pytest.raises(InputError, match="detector: boxes in image 0"):
        _hints_of(Candidates(boxes, classes), 0, "residual", 0.0)
    with pytest.raises(InputError, match="detector: objectness in image 0"):
        _hints_of(Candidates(torch.rand(1, 5, 4), classes, torch.full((1, 5), 2.0)), 0, "residual", 0.0)


CANVAS = (200, 200)


def scan(height=600, width=900, colour=(255, 255, 255), seed=0):
    """A picture whose right part is blank, along a line that is not upright."""
    array = pixels(height, width, seed=seed)
    y, x = np.mgrid[:height, :width]
    blank = x > 400 + y // 5
    array[blank] = colour
    return array, blank


@pytest.mark.parametrize("colour", [(0, 0, 0), (255, 255, 255), (12, 200, 90)])
@pytest.mark.parametrize("large", [1 << 24, 1 << 15])  # pictures with more pixels are read from reduced copies
def test_blank_cells_are_those_whose_pixels_are_all_blank(monkeypatch, colour, large):
    monkeypatch.setattr("semfov.data.windowed._LARGE", large)
    array, blank = scan(colour=colour)
    lattice = Lattice.over((900, 600), CANVAS)
    cells = blank_cells(open_large(array), lattice)
    for row in range(lattice.rows):
        for column in range(lattice.columns):
            x1, y1 = (int(n * pitch) for n, pitch in zip((column, row), lattice.pitch, strict=True))
            x2, y2 = (int(np.ceil((n + 1) * p)) for n, p in zip((column, row), lattice.pitch, strict=True))
            whole, near = (blank[max(y1 - m, 0) : y2 + m, max(x1 - m, 0) : x2 + m].all() for m in (0, 8))
            assert near <= bool(cells[row, column]) <= whole


def test_one_colour_inside_a_picture_is_something_unless_it_is_no_data(tmp_path):
    """A white roof is no border; a hole of a file that tells which pixels are none is blank."""
    array = pixels(600, 900)
    lattice = Lattice.over((900, 600), CANVAS)
    assert blank_cells(open_large(array), lattice) is None
    array[:100] = 255
    array[300:400, 300:500] = 255
    only_border = blank_cells(open_large(array), lattice)
    assert only_border[:3].all()
    assert not only_border[4:].any()
    alpha = np.where((array == 255).all(-1), 0, 255).astype(np.uint8)
    tifffile.imwrite(tmp_path / "a.tif", np.dstack([pixels(600, 900), alpha]), photometric="rgb", extrasamples=[2])
    tifffile.imwrite(
        tmp_path / "b.tif", array, photometric="rgb", extratags=[(42113, "s", 0, "255", True)], tile=(64, 64)
    )
    for name in ("a.tif", "b.tif"):
        cells = blank_cells(open_large(tmp_path / name), lattice)
        wide, high = lattice.pitch
        assert torch.equal(cells[: int(250 / high)], only_border[: int(250 / high)])
        assert cells[int(300 / high + 1) : int(400 / high), int(300 / wide + 1) : int(500 / wide)].all()
        assert not cells[int(400 / high) + 1 :].any()


@pytest.mark.parametrize("share", [0.3, 0.6, 0.8])
def test_what_reaches_the_border_does_so_step_by_step(share):
    rng = np.random.default_rng(0)
    for _ in range(50):
        cells = rng.random(rng.integers(1, 20, 2)) < share
        ground = np.pad(cells, 1, constant_values=True)
        reached = np.zeros_like(ground)
        reached[[0, -1]] = True
        reached[:, [0, -1]] = True
        for _ in range(ground.size):
            reached[1:-1] |= ground[1:-1] & (reached[:-2] | reached[2:])
            reached[:, 1:-1] |= ground[:, 1:-1] & (reached[:, :-2] | reached[:, 2:])
        np.testing.assert_array_equal(reaching_border(cells), reached[1:-1, 1:-1])


def test_blank_ground_in_a_maze_is_found_at_once():
    """Step by step it would take as many steps as the way is long, half a million."""
    maze = np.ones((1025, 1024), bool)
    maze[1::2] = False
    maze[1::4, -1] = True
    maze[3::4, 0] = True
    inside = np.pad(maze, 2)
    inside[:3, 2] = True  # the way in
    np.testing.assert_array_equal(reaching_border(inside), inside)


def test_slices_of_blank_ground_are_left_out():
    array, blank = scan()
    lattice = Lattice.over((900, 600), CANVAS)
    seen = usual_slices(lattice, blank_cells(open_large(array), lattice))
    assert 0 < len(seen) < len(usual_slices(lattice))
    for window in usual_slices(lattice):
        x1, y1, x2, y2 = map(int, window.within)
        assert (window in seen) or blank[y1 + 16 : y2 - 16, x1 + 16 : x2 - 16].all()
    nothing = torch.ones(lattice.rows, lattice.columns, dtype=torch.bool)
    assert usual_slices(lattice, nothing) == usual_slices(lattice)


def test_what_is_left_to_explore_is_what_is_not_blank():
    array, _ = scan()
    lattice = Lattice.over((900, 600), CANVAS)
    cells = blank_cells(open_large(array), lattice)
    belief = ZoomBelief(lattice, GlimpseEvidence(3), 1, lambda: cells)
    assert cells.any()
    assert torch.equal(belief.unexplored, 1 - cells.float())
