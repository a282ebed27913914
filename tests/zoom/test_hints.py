"""What a look at the whole tells of finer looks: hints of objects, and places that are blank."""

import math

import numpy as np
import pytest
import tifffile
import torch
from torch import Tensor

from semfov import Detector, InputError, Selection, WindowEye
from semfov.data.large import open_large
from semfov.detection import Candidates
from semfov.detection.detector import FAINT
from semfov.zoom import GlimpseEvidence, Lattice
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.blank import blank_cells
from semfov.zoom.eye import _hints_of
from semfov.zoom.glances import LiveGlances, Window
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.slices import usual_slices
from tests.data.test_large import pixels

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
    glance = LiveGlances(eye, view).see([window])[0]
    look = glance.gist
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
    torch.testing.assert_close(glance.show, strongest.amax((0, 1)), rtol=1e-5, atol=1e-7)
    found = glance.detections.scores[0, :, 1:].amax(-1) >= DETECTION_SCORE
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
    together = eye.glance(view, fixations)
    assert len({len(hints.boxes) for hints in together.hints}) == 3
    for number, hints in enumerate(together.hints):
        alone = eye.glance(view, fixations[number : number + 1]).hints[0]
        for name in ("boxes", "scores"):
            assert torch.equal(getattr(hints, name), getattr(alone, name))


def test_a_look_without_hints_shows_its_detections():
    detector = Given(400)
    eye = WindowEye(detector)
    view = eye.open(torch.zeros(3, 384, 512))
    last = view.lattice.levels - 1
    window = Window.on(view.lattice, (last, 3, 3))
    plain, hinted = (LiveGlances(eye, view).see([window], hints=hints)[0] for hints in (False, True))
    assert plain.gist is None
    assert hinted.gist is None
    assert torch.equal(plain.show, plain.detections.scores[0, :, 1:].amax(0))
    every = detector.certain[:, None] * detector.scores / detector.scores.sum(-1, keepdim=True)
    torch.testing.assert_close(hinted.show, every.amax(0))


def test_hints_share_the_scores_of_detections_for_any_background():
    for policy in ("residual", "normalised", "uniform", "none"):
        detector = Given(80, policy)
        eye = WindowEye(detector)
        seen = eye.glance(eye.open(torch.zeros(3, 128, 128)), torch.tensor([[63.5, 63.5, 1.0]]))
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


def test_what_is_left_to_see_of_a_window_is_of_what_is_not_blank():
    """Nor to where little is not blank: the share that counts is of a quarter of the window at least."""
    array, _ = scan()
    lattice = Lattice.over((900, 600), CANVAS)
    cells = blank_cells(open_large(array), lattice)
    belief = ZoomBelief(lattice, GlimpseEvidence(3, 8), 1, lambda: cells)
    assert torch.equal(belief.left, belief.there)
    for level in range(1, lattice.levels):
        span = lattice.span(level)
        unseen = belief.unseen(level)
        for row in range(unseen.shape[0]):
            for column in range(unseen.shape[1]):
                part = ~cells[row : row + span, column : column + span].numpy()
                whole = min(span, lattice.rows) * min(span, lattice.columns)
                assert np.isclose(unseen[row, column], min(1, part.sum() / (whole / 4)))
