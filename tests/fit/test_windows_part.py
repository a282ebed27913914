"""The part of a fit for windows: its evidence, kinds of windows, and a fit that is interrupted."""

from dataclasses import replace

import pytest
import torch

from semfov import ActivePerception, EmbeddedScenes
from semfov.data.mosaics import Mosaics
from semfov.fit.detector import _FolderFit, _manifest_of
from semfov.fit.settings import FitDetectorConfig
from semfov.fit.windows_evidence import ZoomExample
from semfov.fit.windows_part import _RECALL_PASSES, WindowsFit, _photograph_recalls
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.manifest import Manifest
from semfov.model_folder import ModelFolder
from semfov.runs.config import DataConfig
from semfov.runs.looking import Looking
from semfov.runs.progress import WholeBar
from semfov.runs.window_looking import found_in
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom import GlimpseEvidence, WindowEye
from semfov.zoom.episode import look_by_look
from semfov.zoom.lattice import Lattice
from semfov.zoom.slices import ranked, usual_slices
from tests.colours import COLOURS, write_home
from tests.small import RedBoxes, Tiles
from train.zoom_pictures import PICTURE_KINDS, _compose_pictures


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """The parent folder of a network and of photographs, 16 of which are held out."""
    return write_home(tmp_path_factory.mktemp("windows"), 48)


def folder_of(home, **settings):
    """The fits of a folder; the parts before the last one are not made."""
    root = home / "photographs"
    config = FitDetectorConfig(
        model=home / "colours.onnx",
        data=DataConfig(root, root / "instances.json", min_instances=0, max_target_area=None),
        columns=4, rows=4, window_steps=8, workers=1,
        out=home / "models", cache=home / "cache",
    )  # fmt: skip
    config = replace(config, **settings).named()
    return _FolderFit(config, Looking(replace(config, out=config.out / "progress")))


@pytest.mark.slow
def test_the_agent_of_the_folder_has_the_evidence_and_an_interrupted_fit_continues(home, tmp_path, monkeypatch):
    usual = WindowsFit.mosaics

    def fewer(*given):
        return replace(usual(*given), mosaics=2, crowded=1, judged=2, searched=2)

    monkeypatch.setattr(WindowsFit, "mosaics", fewer)
    folder, used = folder_of(home), []
    tasks, task = folder.fits["windows"].tasks, WholeBar.task
    with monkeypatch.context() as noting, WholeBar("fitting", {"windows": tasks}) as whole, whole.stage("windows"):
        noting.setattr(WholeBar, "task", lambda bar, title, total: used.append(title) or task(bar, title, total))
        fitted = folder.fit("windows")
    assert {*used} == {*tasks}
    config = folder.fits["windows"].settings
    assert isinstance(config, FitMosaicsConfig)
    # Slots of 4 to 3 that hold square photographs of 64 pixels would be 85 wide, more than the detector needs.
    assert config.tile == 74
    model = GlimpseEvidence.from_pretrained(home / "models" / fitted.part.file)
    assert model.thresholds is not None
    assert "% of the objects are found in 16 passes" in fitted.part.why
    assert all(f"| {name} " in fitted.report for name in ("fitted", "raw"))
    # Looks and the finished part are read again; only the fit is repeated when its record is lost.
    before = (home / "models/windows.safetensors").read_bytes()
    (home / "models/progress/windows.json").unlink()
    with monkeypatch.context() as stored:
        stored.setattr("semfov.data.mosaics.Mosaics.__getitem__", None)
        assert folder_of(home).fit("windows") == fitted
    assert (home / "models/windows.safetensors").read_bytes() == before
    monkeypatch.setattr("semfov.fit.windows_part._fit_mosaics", None)
    folder = folder_of(home)
    assert folder.fit("windows") == fitted
    part = replace(fitted.part, used=True)
    folder.inputs.results["windows"] = fitted._replace(part=part)
    _manifest_of(folder).write(home / "models")
    agent = ActivePerception.from_pretrained(home / "models")
    assert all(torch.equal(tensor, model.state_dict()[name]) for name, tensor in agent.windows.state_dict().items())
    picture = torch.full((3, 192, 256), 0.49)
    picture[:, ::2] = 0.53  # ground of one colour would count as blank
    picture[:, 96:104, 160:168] = torch.from_numpy(COLOURS[2] / 255).float()[:, None, None]
    record = agent.find_all(picture, "blue", how="windows", passes=16)
    assert len(record.objects) == 1
    torch.testing.assert_close(record.objects.boxes[0], torch.tensor([160.0, 96, 168, 104]), atol=4, rtol=0)
    # A part that is not used, or that a folder lacks, leaves the agent without it.
    for parts in ({"windows": fitted.part.__class__(None, None, False, "")}, {}):
        replace(Manifest.read(home / "models"), parts=parts).write(home / "models")
        assert ModelFolder(home / "models").arguments()["windows"] is None


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        ({"windows": False}, "not fitted, since the setting `windows` is false"),
        (
            {"holdout": 4},
            "not fitted, since mosaics need at least 16 held-out photographs, and 12 of the 48 photographs are held "
            "out",
        ),
    ],
)
def test_the_evidence_is_left_out_with_a_reason(home, tmp_path, monkeypatch, settings, why):
    monkeypatch.setattr("semfov.fit.windows_part._fit_mosaics", None)
    folder = folder_of(home, out=tmp_path, **settings)
    assert folder.fits["windows"].tasks == {}
    part = folder.fit("windows").part
    assert (part.file, part.used, part.why) == (None, False, why)


def test_recall_is_that_of_the_objects_of_each_photograph():
    eye, scenes = WindowEye(Tiles(name="bright")), EmbeddedScenes(("person", "cat", "cup"), count=5)
    mosaics = Mosaics(scenes, 2, 2, tile=(96, 72), count=3)
    opened = [StoredGlances(eye, mosaics, index, None) for index in range(3)]
    shares = {}
    for index, glances in enumerate(opened):
        tiles = mosaics.tiles(index)
        looks = [turn.glance for turn in look_by_look(glances, ranked(usual_slices(glances.lattice)), None)]
        found = torch.stack([found_in(looks[:n], mosaics.annotation(index)) for n in range(1, len(looks) + 1)], -1)
        # When all slices were looked at, recall stays the same.
        assert len(looks) < _RECALL_PASSES[-1]
        found = torch.cat([found, found[:, -1:].expand(-1, _RECALL_PASSES[-1] - len(looks))], -1).double()
        counts = [len(scenes.annotation(tile.scene).boxes) for tile in tiles]
        for tile, part in zip(tiles, found.split(counts), strict=True):
            shares.setdefault(tile.scene, []).append(part.mean(0))
    expected = torch.stack([torch.stack(shares[photograph]).mean(0) for photograph in sorted(shares)])
    assert expected.amax() > 0
    torch.testing.assert_close(torch.from_numpy(_photograph_recalls(mosaics, opened, None)), expected)


SCENES = RedBoxes()
SIZES = {
    "few": (144, 108), "many": (288, 216), "one class": (192, 108), "photographs": (384, 216), "objects": (384, 216)
}  # fmt: skip


@pytest.mark.parametrize("kind", PICTURE_KINDS)
def test_pictures_of_a_kind_have_its_size_and_objects_and_depend_on_the_seed(kind):
    pictures = _compose_pictures(kind, SCENES, 3, 0, tile=48)
    assert len(pictures) == 3
    for index in range(3):
        assert pictures.annotation(index).size == SIZES[kind]
    assert sum(len(pictures.annotation(index).boxes) for index in range(3)) > 0
    assert pictures[0].size == SIZES[kind]
    assert _compose_pictures(kind, SCENES, 3, 1, tile=48).digest(0) != pictures.digest(0)
    assert _compose_pictures(kind, SCENES, 4, 0, tile=48).digest(0) == pictures.digest(0)


@pytest.mark.parametrize(("kind", "photographs"), [("few", 9), ("objects", 0)])
def test_windows_hold_one_for_each_photograph_of_a_mosaic(kind, photographs):
    pictures = _compose_pictures(kind, SCENES, 1, 0, tile=48)
    lattice = Lattice.over(SIZES[kind], (32, 32))
    assert sum(window.within is not None for window in ZoomExample.windows(pictures, 0, lattice)) == photographs


def test_objects_of_the_smallest_kinds_have_four_pixels_in_an_overview():
    """Of 416 px, in pictures of the default size."""
    pictures = _compose_pictures("objects", SCENES, 12, 0)
    told = [pictures.annotation(index).boxes for index in range(12)]
    sides = torch.cat([(boxes[:, 2:] - boxes[:, :2]).amax(-1) for boxes in told])
    assert 2 < float(sides.quantile(0.1)) * 416 / 3840 < 8
