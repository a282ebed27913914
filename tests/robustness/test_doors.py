"""Public entry points with right and wrong arguments: the right result, or an error with argument and remedy."""

import io
import math
import re

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

import semfov
from semfov import (
    ActivePerception,
    WindowEye,
    ZoomAgent,
    as_image,
    attribute_words,
    foveate,
    read_image,
    words,
)
from semfov.belief import Verification
from semfov.data.classes import _SYNONYMS, class_index
from semfov.data.large import open_large
from semfov.decision import Decision
from semfov.detection import Objects
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.load import check_detector
from semfov.errors import SemfovError
from semfov.gaze.saliency import VOCUS2, IttiKoch
from semfov.live import LivePerception
from semfov.paths import GazePrediction, Scanpath, WindowMoment
from semfov.paths.outcome import NumberByClass
from semfov.report.episode import episode_data
from semfov.report.zoom import zoom_data
from semfov.settings import ExploreSettings, FindSettings, SearchSettings, StreamSettings
from semfov.viz import plot_scanpath
from semfov.zoom import GlimpseEvidence
from tests import small

CUP = small.Fixed(("cup", "wine glass"))
RNG = np.random.default_rng(0)
PIXELS = RNG.integers(0, 256, (30, 44, 3), dtype=np.uint8)
GREY = RNG.integers(0, 256, (30, 44), dtype=np.uint8)
DEEP = RNG.integers(0, 65536, (30, 44), dtype=np.uint16)
RGB = torch.from_numpy(PIXELS).permute(2, 0, 1) / 255
GREYS = torch.from_numpy(GREY)[None].expand(3, -1, -1) / 255
DEEPS = torch.from_numpy(DEEP.astype(np.int32))[None].expand(3, -1, -1) / 65535


@pytest.fixture(scope="module")
def agent():
    return small.agent(CUP, grid=(4, 3), sigma=10.0, reference=64.0)


@pytest.fixture(scope="module")
def zooming():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return ZoomAgent(WindowEye(CUP), GlimpseEvidence(2)).eval()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a photograph, files that are not images, and an empty folder."""
    path = tmp_path_factory.mktemp("pictures")
    Image.fromarray(PIXELS).save(path / "photo.png")
    (path / "notes.txt").write_text("no picture")
    (path / "cut.png").write_bytes((path / "photo.png").read_bytes()[:200])
    (path / "empty").mkdir()
    return path


def stored_sideways():
    """A photograph that is stored sideways, with the EXIF orientation that turns it upright."""
    exif = Image.Exif()
    exif[0x0112] = 6
    file = io.BytesIO()
    Image.fromarray(np.rot90(PIXELS)).save(file, format="PNG", exif=exif)
    return Image.open(file)


def half_transparent():
    """A photograph whose left half is transparent."""
    alpha = np.full((30, 44, 1), 255, np.uint8)
    alpha[:, :22] = 0
    return Image.fromarray(np.concatenate([PIXELS, alpha], -1), "RGBA")


WHITE = RGB.clone()
WHITE[:, :, :22] = 1
PALETTE = Image.fromarray(PIXELS).quantize(16)

PICTURES = {
    "str": (lambda folder: str(folder / "photo.png"), RGB),
    "path": (lambda folder: folder / "photo.png", RGB),
    "pillow": (lambda _: Image.fromarray(PIXELS), RGB),
    "pillow file": (lambda folder: Image.open(folder / "photo.png"), RGB),
    "pillow sideways": (lambda _: stored_sideways(), RGB),
    "pillow alpha": (lambda _: half_transparent(), WHITE),
    "pillow grey": (lambda _: Image.fromarray(GREY), GREYS),
    "pillow grey alpha": (lambda _: Image.fromarray(GREY).convert("LA"), GREYS),
    "pillow 16 bits": (lambda _: Image.fromarray(DEEP), DEEPS),
    "pillow palette": (lambda _: PALETTE, torch.from_numpy(np.array(PALETTE.convert("RGB"))).permute(2, 0, 1) / 255),
    "array": (lambda _: PIXELS, RGB),
    "array CHW": (lambda _: PIXELS.transpose(2, 0, 1), RGB),
    "array of floats": (lambda _: (PIXELS / 255).astype(np.float32), RGB),
    "array of doubles CHW": (lambda _: PIXELS.transpose(2, 0, 1) / 255, RGB.double()),
    "array grey": (lambda _: GREY, GREYS),
    "array grey (H, W, 1)": (lambda _: GREY[..., None], GREYS),
    "array grey (1, H, W)": (lambda _: GREY[None] / np.float32(255), GREYS),
    "array 16 bits": (lambda _: DEEP, DEEPS),
    "array 16 bits big endian": (lambda _: DEEP.astype(">u2"), DEEPS),
    "array BGR turned round": (lambda _: np.ascontiguousarray(PIXELS[..., ::-1])[..., ::-1], RGB),
    "array that is read only": (lambda _: np.asarray(Image.fromarray(PIXELS)), RGB),
    "array batch of one": (lambda _: PIXELS[None], RGB),
    "tensor": (lambda _: RGB, RGB),
    "tensor batch of one": (lambda _: RGB[None], RGB),
    "tensor of bytes": (lambda _: torch.from_numpy(PIXELS).permute(2, 0, 1), RGB),
    "tensor of bytes HWC": (lambda _: torch.from_numpy(PIXELS), RGB),
    "tensor of doubles": (lambda _: RGB.double(), RGB.double()),
    "tensor grey": (lambda _: torch.from_numpy(GREY), GREYS),
    "tensor 16 bits": (lambda _: torch.from_numpy(DEEP), DEEPS),
}


@pytest.mark.parametrize("kind", PICTURES)
def test_images_of_any_type_are_accepted(kind, folder, agent, zooming):
    """Every function that takes an image reads the same pixel values."""
    make, expected = PICTURES[kind]
    image = as_image(make(folder))
    assert image.dtype == expected.dtype
    torch.testing.assert_close(image, expected, atol=1e-6, rtol=0)
    own = expected.float()
    as_agents = as_image(make(folder), like=torch.zeros(1))
    assert as_agents.dtype == torch.float32
    torch.testing.assert_close(as_agents, own, atol=1e-6, rtol=0)
    with torch.inference_mode():
        if kind in ("path", "pillow alpha", "array 16 bits", "tensor batch of one"):
            for look in (agent.search(make(folder), "cup", seed=3), agent.explore(make(folder), shifts=2, seed=3)):
                assert look.grid.size == (44, 30)
        views = agent.eye.open(make(folder)), agent.eye.open(own[None])
        torch.testing.assert_close(views[0].state[0].base, views[1].state[0].base, atol=1e-6, rtol=0)
        view = foveate(make(folder), (20, 12), sigma=8.0)
        wanted = foveate(expected[None], torch.tensor([20.0, 12.0]), sigma=8.0)[0]
        torch.testing.assert_close(view.reshape(wanted.shape), wanted, atol=1e-6, rtol=0)
        seen = zooming.eye.open(make(folder)).picture.read((0, 0, 44, 30))
        torch.testing.assert_close(seen / 255, own, atol=0.5 / 255 + 1e-6, rtol=0)


MEAN, STD = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
NORMALISED = ((RGB.permute(1, 2, 0) - MEAN) / STD).permute(2, 0, 1)


def closed():
    image = Image.fromarray(PIXELS)
    image.close()
    return image


INVALID_IMAGES = {
    "0 to 255": (lambda _: RGB * 255, r"expected RGB in \[0, 1\], got numbers from 0 to 255; divide by 255"),
    "array 0 to 255": (lambda _: PIXELS.astype(np.float32), "divide by 255"),
    "0 to 65535": (lambda _: RGB * 65535, "divide by the value of white"),
    "normalised": (lambda _: NORMALISED, r"undo the normalisation: image \* std \+ mean, for ImageNet"),
    "-1 to 1": (lambda _: RGB * 2 - 1, r"\(image \+ 1\) / 2"),
    "resampled": (lambda _: RGB * 1.1, r"clamp to \[0, 1\]"),
    "NaN": (lambda _: RGB.masked_fill(RGB > 0.9, torch.nan), "got NaN; replace"),
    "infinity": (lambda _: RGB.masked_fill(RGB > 0.9, torch.inf), "to inf; replace"),
    "batch": (lambda _: RGB.expand(4, -1, -1, -1), "expected one picture, got a batch of 4; give them one by one"),
    "array batch": (lambda _: PIXELS[None].repeat(2, 0), "expected one picture, got a batch of 2"),
    "two channels": (lambda _: RGB[:2], r"expected a picture of shape .*with 3 channels or 1, got shape \(2, 30, 44\)"),
    "four channels": (lambda _: np.dstack([PIXELS, GREY]), "drop the fourth channel, or give the Pillow image"),
    "row": (lambda _: RGB[0, 0], r"expected a picture of shape .*got shape \(44,\)"),
    "five axes": (lambda _: RGB[None, None], r"got shape \(1, 1, 3, 30, 44\)"),
    "empty": (lambda _: RGB[:, :0], "expected at least one pixel"),
    "empty array": (lambda _: PIXELS[:, :0], "expected at least one pixel"),
    "sparse": (lambda _: RGB.to_sparse(), "expected a dense tensor, got a sparse one; use image.to_dense"),
    "either way round": (lambda _: PIXELS[:3], r"got shape \(3, 44, 3\), which is ambiguous"),
    "long integers": (lambda _: PIXELS.astype(np.int64), r"expected bytes.*int64; convert it to bytes"),
    "tensor of integers": (lambda _: (RGB * 255).int(), r"expected bytes.*torch\.int32; convert it to bytes"),
    "mask": (lambda _: RGB > 0.5, r"expected bytes.*torch\.bool"),
    "complex": (lambda _: PIXELS * 1j, "expected bytes.*complex128"),
    "objects": (lambda _: PIXELS.astype(object), "expected bytes.*object"),
    "None": (lambda _: None, "expected a path.*got None \\(OpenCV returns None"),
    "list": (lambda _: [RGB, RGB], "expected a path.*got a list; give pictures one by one"),
    "bytes": (lambda _: b"x", r"got bytes of a file; open them with PIL\.Image\.open\(io\.BytesIO"),
    "file object": (lambda _: io.BytesIO(b"x"), r"got an open file, BytesIO; give its path, or open it with PIL"),
    "stream": (lambda _: "rtsp://admin:secret@camera/1", "expected a file on this machine.*rtsp://….*use live"),
    "address": (lambda _: "https://example.org/cup.jpg", "expected a file on this machine.*download it first"),
    "missing": (lambda folder: folder / "nosuch.jpg", r"nosuch\.jpg: no such file; check"),
    "folder": (
        lambda folder: folder,
        "expected a file, got a folder|expected one picture; semfov.run looks at folders",
    ),
    "text": (lambda folder: folder / "notes.txt", r"notes\.txt: not an image in a format that is read"),
    "half a file": (lambda folder: folder / "cut.png", r"cut\.png: truncated, damaged"),
    "half a file, opened": (
        lambda folder: Image.open(io.BytesIO((folder / "cut.png").read_bytes())),
        "(image|picture): truncated, damaged or closed",
    ),
    "closed": (lambda _: closed(), "(image|picture): truncated, damaged or closed.*open it again"),
}


@pytest.mark.parametrize("kind", INVALID_IMAGES)
def test_invalid_images_are_refused_with_the_remedy(kind, folder, agent):
    """Every function that takes an image raises an error of one line that starts with the argument."""
    make, message = INVALID_IMAGES[kind]
    for function in (as_image, lambda image: agent.search(image, "cup"), agent.explore):
        with pytest.raises(SemfovError, match=message) as error:
            function(make(folder))
        assert str(error.value).startswith(("image", "picture"))
        assert "\n" not in str(error.value)


@pytest.mark.slow
def test_foveation_accepts_batches():
    """Foveation accepts batches with any number of channels and any range of values, and passes gradients."""
    batch = RGB[None].repeat(2, 1, 1, 1)
    gaze = [[3, 4], [20, 12]]
    wanted = foveate(batch, torch.tensor(gaze), sigma=6.0)
    torch.testing.assert_close(foveate(batch, gaze, sigma=6.0), wanted)
    torch.testing.assert_close(foveate(batch, np.array(gaze), sigma=6.0), wanted)
    torch.testing.assert_close(foveate((batch * 255).byte(), gaze, sigma=6.0), wanted, atol=5e-3, rtol=0)
    assert foveate(torch.randn(2, 5, 16, 16), (3, 4), sigma=6.0).shape == (2, 5, 16, 16)
    several = foveate(RGB, gaze, sigma=6.0)
    torch.testing.assert_close(several, wanted)
    torch.testing.assert_close(foveate(RGB, tuple(gaze[1]), sigma=6.0), wanted[1])
    image = RGB.clone().requires_grad_()
    as_image(image, like=torch.zeros(1, dtype=torch.float64)).sum().backward()
    torch.testing.assert_close(image.grad, torch.ones_like(image))
    image.grad = None
    foveate(image, (3, 4), sigma=6.0).sum().backward()
    assert image.grad.abs().sum() > 0


def test_fixations_may_be_tuples_lists_and_arrays(agent):
    view = agent.eye.open(PIXELS)
    wanted = agent.eye.look(view, torch.tensor([[20.0, 12.0]])).boxes
    for fixation in ((20, 12), [20.0, 12.0], np.array([20, 12]), [[20, 12]]):
        assert torch.equal(agent.eye.look(view, fixation).boxes, wanted)
    with pytest.raises(SemfovError, match=r"^fixations: expected"):
        agent.eye.look(view, "here")


NAMES = {
    "Wine_Glass": "wine glass", "wineglass": "wine glass", "WINE-GLASS": "wine glass", "  wine  glasses ": "wine glass",
    "Cups": "cup", "people": "person", "persons": "person", "knives": "knife", "buses": "bus", "mice": "mouse",
    "Sandwiches": "sandwich", "ski": "skis", "sofa": "couch", "sofas": "couch", "TV monitor": "tv", "tvs": "tv",
    "motorbikes": "motorcycle", "teddy-bears": "teddy bear", "hotdog": "hot dog", "scissor": "scissors",
}  # fmt: skip


def test_classes_are_recognised_in_other_spellings_and_types(agent):
    for name, known in NAMES.items():
        assert COCO_CLASSES[class_index(name, COCO_CLASSES) - 1] == known
    for index in [2, np.int64(2), np.uint8(2), torch.tensor(2)]:
        assert agent.search(PIXELS, index, shifts=0).target == 2


SUGGESTED = {
    "mug": "cup", "Mugs": "cup", "coffee cup": "cup", "phone": "cell phone", "smartphones": "cell phone",
    "plane": "airplane", "fridge": "refrigerator", "puppy": "dog", "women": "person", "bike": "bicycle' or 'motorcycle",
    "glass": "wine glass' or 'cup", "zebr": "zebra", "bycicle": "bicycle", "trafic light": "traffic light",
    "monitor": "tv", "doughnuts": "donut", "giraff": "giraffe", "football": "sports ball",
}  # fmt: skip


def test_unknown_names_are_refused_with_a_suggested_class():
    for name, meant in SUGGESTED.items():
        with pytest.raises(SemfovError, match=rf"^target: unknown class '{name}'; did you mean '{re.escape(meant)}'"):
            class_index(name, COCO_CLASSES, "target")
    for word, classes in _SYNONYMS.items():
        assert set(classes) <= set(COCO_CLASSES)
        assert word not in {name.replace(" ", "") for name in COCO_CLASSES}
    with pytest.raises(SemfovError, match=r"^target: unknown class 'mug'; known: person, dog"):
        class_index("mug", ("person", "dog"), "target")


@pytest.mark.parametrize("target", ["", "qqqq", 0, 3, -1, 10**12, True, 1.0, None, ["cup"], torch.ones(2)])
def test_invalid_targets_are_refused(target, agent, zooming):
    searches = [zooming.search]
    searches += [] if isinstance(target, list) else [agent.search]
    searches += [] if isinstance(target, list) or target is None else [zooming.find_all]
    for search in searches:
        with pytest.raises(SemfovError, match=r"^target: (expected a name, or a whole number from 1 to 2|unknown)"):
            search(PIXELS, target)


ARGUMENTS = [
    ("shifts", -1), ("shifts", 10**9), ("shifts", 2.5), ("seed", -1), ("seed", 2**64), ("seed", 1.5),
    ("seed", None), ("start", 12), ("start", -1), ("start", True), ("start", "middle"),
    ("confirm", 50), ("confirm", -0.1), ("confirm", "high"), ("stop_below", 2),
    ("stop_below", float("nan")),
]  # fmt: skip


def test_invalid_gazes_and_arguments_of_a_search_are_refused_by_name(agent):
    for gaze in [(1, 2, 3), "ab", None, [[1, 2], [3]], (float("nan"), 2), 5, {}, []]:
        with pytest.raises(SemfovError, match=r"^gaze: expected "):
            foveate(RGB, gaze, sigma=6.0)
    for name, value in ARGUMENTS:
        with pytest.raises(SemfovError, match=f"^{name}: expected "):
            agent.search(PIXELS, "cup", **{name: value})


@pytest.mark.parametrize(
    ("method", "name", "remedy"),
    [
        ("search", "pases", "did you mean passes="),
        ("search", "conf", "did you mean confirm="),
        ("find_all", "threshold", "did you mean score_threshold="),
        ("explore", "max_steps", "did you mean passes="),
        ("live", "colour", "did you mean color="),
        ("gaze", "degrees", "known: picture, model, "),
        ("find_all", "slice_height", "semfov chooses the windows"),
        ("find_all", "imgsz", r"an agent is made with it: semfov.ActivePerception.recommended\(input_size="),
        ("search", "device", "an agent is made with it"),
        ("explore", "save", r"the record has what is to be written and shown: record.report\(path\)"),
    ],
)
def test_unknown_keywords_are_refused_with_the_near_ones(method, name, remedy, agent):
    with pytest.raises(SemfovError, match=f"^{name}: expected an option of {method}, got an unknown one; {remedy}"):
        getattr(agent, method)(PIXELS, "cup", **{name: 1})


@pytest.mark.parametrize(
    ("method", "former", "present"),
    [
        ("search", "give_up", "stop_below"),
        ("find_all", "least", "score_threshold"),
        ("find_all", "worth", "min_gain"),
        ("live", "least", "score_threshold"),
    ],
)
def test_earlier_names_of_settings_are_taken_with_a_note(method, former, present, agent):
    """They reach the same check, under the present name."""
    picture = () if method == "live" else (PIXELS,)
    with (
        pytest.warns(FutureWarning, match=f"^{former} is called {present} now"),
        pytest.raises(SemfovError, match=f"^{present}: expected a .*, got -1"),
    ):
        getattr(agent, method)(*picture, "cup", **{former: -1})
    with pytest.raises(SemfovError, match=f"^{present}: expected one value, got another as {former}"):
        getattr(agent, method)(*picture, "cup", **{former: 0.5, present: 0.5})


def test_a_run_takes_earlier_names_and_settings_name_the_present_ones(agent):
    with (
        pytest.warns(FutureWarning, match="^least is called score_threshold now") as noted,
        pytest.raises(SemfovError, match=r"^score_threshold: expected a .*, got -1"),
    ):
        semfov.run("a.jpg", "cup", agent=agent, least=-1)
    assert noted[0].filename == __file__
    for kind, former, present in [
        (FindSettings, "least", "score_threshold"), (ExploreSettings, "worth", "min_gain"),
        (SearchSettings, "give_up", "stop_below"), (StreamSettings, "give_up", "stop_below"),
    ]:  # fmt: skip
        said = f"^{former}: expected an option of {kind.__name__}, .* did you mean {present}="
        with pytest.raises(SemfovError, match=said):
            kind(**{former: 0.5})
    with pytest.raises(SemfovError, match=r"^iou: .* agent=semfov\.ActivePerception\.recommended\(iou=…\)$"):
        semfov.run("a.jpg", "cup", agent=agent, iou=0.5)
    with pytest.warns(FutureWarning, match="least is called score_threshold now"):
        assert small.Fixed(("cup",), least=0.4).score_threshold == 0.4


@pytest.mark.parametrize("options", [{"how": "fovea", "shifts": 3}, {"passes": 2}])
def test_belief_maps_are_counted_from_0_and_from_the_end(options, agent):
    record = agent.search(PIXELS, "cup", **options)
    count = len(record)
    for number in range(count):
        first = record.belief_map(number)
        last = record.belief_map(number - count)
        assert first is last is None or torch.equal(first[1], last[1])
    for number in (count, -count - 1, 0.5, None):
        with pytest.raises(SemfovError, match=f"^index: expected a whole number from -{count} to {count - 1}, got"):
            record.belief_map(number)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (
            lambda agent: agent.search(PIXELS),
            "search: missing a required argument: 'target'; expected picture, target, how=",
        ),
        (
            lambda agent: agent.search(PIXELS, "cup", 3),
            "search: too many positional arguments; expected picture, target, ",
        ),
        (lambda agent: agent.search(PIXELS, "cup", target="cup"), "search: multiple values for argument 'target'"),
        (lambda agent: type(agent)("yolox-nano"), "ActivePerception: missing a .*'search'; .*recommended.. makes one"),
        (lambda agent: agent.eye.detector(PIXELS), r"images: .*got a \w+; give semfov.as_image"),
        (lambda agent: agent(PIXELS), "an agent is not called itself: it has search, find_all, explore"),
        (lambda agent: agent.forward(PIXELS), "an agent is not called itself: it has search, find_all, explore"),
        (lambda agent: semfov.gaze(PIXELS), r"semfov.gaze is a module, .*; use .*recommended\(\).gaze\(picture\)$"),
        (lambda agent: semfov.saliency(PIXELS), "semfov.saliency is a module, which is not called; use"),
        (lambda agent: semfov.report(PIXELS), r"semfov.report is a module, .*; use record.report\(path\)$"),
        (lambda agent: semfov.live("cup"), r"semfov.live is a module, .*recommended\(\).live\(target\)$"),
        (lambda agent: semfov.demo, "semfov has no attribute 'demo'; use `semfov demo` in a shell$"),
        (lambda agent: agent.device, r"an agent has .* 'device'; use next\(agent.parameters\(\)\).device$"),
        (lambda agent: agent.find_all(PIXELS, top=3), "top: .*; record.objects has all, to sort by their scores$"),
        (lambda agent: agent.find_all(PIXELS).objects.top, r"Objects has .*; use objects\[objects.scores.argsort"),
        (lambda agent: agent.explore(PIXELS).plot(cmap="hot"), "cmap: expected an option of plot_scanpath, got an"),
        (lambda agent: agent.explore(PIXELS).report("a.html", width_px=9), "width_px: .* option of report, .* width="),
        (
            lambda agent: agent.track,
            "an agent has no attribute 'track'; use agent.live.*, whose step",
        ),
        (
            lambda agent: agent.explore(PIXELS, target="cup"),
            "target: .* an unknown one; find_all.*, search",
        ),
        (lambda agent: agent.search("cup", "kitchen.jpg"), "picture: expected the picture before the class, got 'cup'"),
        (lambda agent: agent.find_all("Cups", PIXELS), "picture: expected the picture before the class, got 'Cups'"),
        (lambda agent: agent.search("cup", "cup"), "image cup: no such file"),
        (lambda agent: agent.find_all("."), "picture: expected one picture; semfov.run looks at folders, .*, got \\.$"),
        (
            lambda agent: agent.explore("flight/*.jpg"),
            "picture: expected one picture; semfov.run looks at",
        ),
        (lambda agent: agent.find_all(["a.jpg", "b.jpg"], "cup"), "picture: expected one picture; .*lists of names"),
        (lambda agent: agent.search(PIXELS, ["cup", "fork"]), "target: expected one class; find_all takes several"),
        (lambda agent: agent.find_all(PIXELS).objects.to_csv, r"Objects has .*; use record.to_csv\(path, 'objects'\)"),
        (lambda agent: agent.find_all(PIXELS).objects["cup"], r"index: .*; objects.of\('cup'\) are those of a class"),
        (lambda agent: agent.find_all(PIXELS).objects.of("qqq"), "class: unknown class 'qqq'"),
        (lambda agent: agent.find_all(PIXELS)["person"], r"record: .* its objects .* record.objects.of\('person'\)"),
        (lambda agent: agent.find_all(PIXELS)["objects"], r"record: .* got 'objects'; it is record.objects$"),
        (lambda agent: agent.find_all(PIXELS)["target"], r"record: .* got 'target'; it is record.target$"),
        (lambda agent: agent.find_all(PIXELS)["cup", 0], r"record: expected the place of a look.* got \('cup', 0\)$"),
        (lambda agent: agent.save, r"an agent has .* 'save'; use semfov.fit_detector, which writes a folder"),
        (lambda agent: agent.find_all(PIXELS).objects.cups, r"Objects has .* 'cups'; use objects.of\('cup'\)$"),
        (lambda agent: agent.find_all(PIXELS).wine_glass, r".* 'wine_glass'; use record.objects.of\('wine glass'\)$"),
        (lambda agent: agent.search(PIXELS, "cup").decision.is_found, "Decision .*; use decision.outcome == 'found'$"),
        (lambda agent: agent.search(PIXELS, "cup").decision.presence, "Decision .*; use decision.probability$"),
        (lambda agent: agent.search(PIXELS, "cup").decision.position, "Decision .*; use record.found_at$"),
        (lambda agent: agent.live(find="cup"), "find: expected an option of live, .*; did you mean target="),
        (lambda agent: agent.find_all(PIXELS, "cup").expected["qqq"], "expected: unknown class 'qqq'"),
        (lambda agent: agent.search(PIXELS, "cup").decision.found, "Decision .*; use decision.outcome == 'found'"),
        (lambda agent: bool(agent.search(PIXELS, "cup").decision), "decision: .*: decision.outcome == 'found'"),
        (lambda agent: agent.explore(PIXELS, "cup"), "explore: too many .*; find_all.*, search"),
        (lambda agent: agent.gaze(PIXELS, "cup"), "gaze: too many .*; find_all.*, search"),
        (lambda agent: agent.gaze(PIXELS, target="cup"), "target: .* an unknown one; find_all.*, search"),
        (lambda agent: agent.freeze, r"an agent has no attribute 'freeze'; use agent.requires_grad_\(False\)$"),
        (lambda agent: agent.live("cup").release, "LivePerception has .*; use the release of your own capture"),
        (
            lambda agent: agent.explore(PIXELS, shifts=1).to_sv_detections,
            r"Scanpath .*; use record.to_supervision\(\)$",
        ),
        (lambda agent: agent.explore(PIXELS, shifts=1).num_detections, r"Scanpath .*; use len\(record.objects\)"),
        (lambda agent: agent.explore(PIXELS, shifts=1).num_fixations, r"Scanpath .*; use len\(record\)$"),
        (lambda agent: agent.find_all(PIXELS).objects.to_supervision, r"Objects .*; use record.to_supervision\(\)$"),
        (lambda agent: agent.find_all(PIXELS).objects.numpy, "Objects .*; use objects.boxes, .* tensors$"),
        (lambda agent: semfov.datasets, "semfov has no attribute 'datasets'; use semfov.data, which reads"),
        (lambda agent: semfov.FoveatedEnv, "semfov has no attribute 'FoveatedEnv'; use semfov.envs"),
        (lambda agent: agent.count, "an agent has no attribute 'count'; use len"),
        (lambda agent: agent.set_classes, "an agent has no attribute 'set_classes'; use the target of search"),
        (lambda agent: agent.search(PIXELS, "cup", prior="15%"), "prior: expected a share, such as 0.15, above 0"),
        (lambda agent: agent.find_all(PIXELS, "cup").objects.filter, "Objects .*; use objects.above"),
        (lambda agent: agent.find_all(PIXELS, "cup").expected.cup, r"expected has .*; use expected\['cup'\]"),
        (lambda agent: agent.explore(PIXELS, shifts=1).boxes, "Scanpath has no attribute 'boxes'; use its objects"),
        (lambda agent: agent.explore(PIXELS, shifts=1).nothing, "Scanpath has no attribute 'nothing'$"),
        (lambda agent: semfov.search, "semfov has no attribute 'search'; use agent = semfov.ActivePerception"),
        (lambda agent: semfov.nothing, "semfov has no attribute 'nothing'$"),
        (lambda agent: semfov.foveat, r"semfov has no attribute 'foveat'; did you mean foveate\?"),
        (lambda agent: agent.find_al, r"an agent has no attribute 'find_al'; did you mean find_all\?"),
        (lambda agent: agent.live("cup").update, r"LivePerception has no attribute 'update'; use live.step\(frame\)"),
        (lambda agent: agent.explore(PIXELS, shifts=1).score, "Scanpath has .*; use record.decision.probability$"),
        (lambda agent: agent.explore(PIXELS, shifts=1).outcome, "Scanpath has .*; use record.decision.outcome$"),
        (lambda agent: agent.explore(PIXELS, shifts=1).plot("x.png"), "ax: .* 'x.png'; .* semfov.viz.save_figure"),
        (lambda agent: agent.explore(PIXELS, shifts=1).compare(None), "people: expected fixations, .*got a NoneType"),
        (lambda agent: agent.explore(PIXELS, shifts=1).compare([3]), "people: expected fixations, records of an agent"),
        (lambda agent: semfov.Foveation("wide"), "sigma: expected a number, got wide"),
        (lambda agent: semfov.Foveation(None), "sigma: expected a number, got None"),
    ],
)
def test_what_others_call_it_and_other_forms_of_a_call_are_refused_with_ours(call, said, agent):
    with pytest.raises((SemfovError, AttributeError, TypeError), match=f"^{said}"):
        call(agent)


def test_functions_take_their_first_argument_by_name_too(agent):
    fovea, windows = agent.explore(PIXELS, shifts=1), agent.find_all(PIXELS, "cup")
    assert plot_scanpath(scanpath=fovea, image=PIXELS).axes
    assert episode_data(scanpath=fovea, image=None, views=None, name="a")["name"] == "a"
    assert zoom_data(path=windows, picture=None, name="a")["name"] == "a"
    with pytest.raises(SemfovError, match=r"^plot_scanpath: too many .*; expected scanpath, image=, boxes="):
        plot_scanpath(fovea, PIXELS, None)
    with pytest.raises(SemfovError, match=r"^scanpth: .* of plot_scanpath, .* did you mean scanpath="):
        plot_scanpath(scanpth=fovea)


def test_numbers_by_class_are_asked_for_in_every_way_of_a_dict_by_the_same_names():
    numbers = NumberByClass({"cup": 2.5, "wine glass": math.nan})
    for name in ("cup", "cups", "Cup", "wine_glasses"):
        assert name in numbers
        assert numbers.get(name, -1) is numbers[name]
    assert "fork" not in numbers
    assert numbers.get("fork", -1) == -1
    assert 3 not in numbers


def test_an_error_in_a_property_of_a_record_is_told():
    class Broken(semfov.paths.Scanpath):
        mine = property(lambda self: [].nope)

    with pytest.raises(AttributeError, match="'list' object has no attribute 'nope'"):
        _ = object.__new__(Broken).mine


def test_an_agent_with_a_forward_of_its_own_is_called(agent):
    class Callable(semfov.ActivePerception):
        forward = staticmethod(lambda picture: picture)

    called = object.__new__(Callable)
    called.__dict__ |= agent.__dict__
    assert called(3) == 3


def test_records_of_agents_are_compared_as_people_are(agent):
    path = agent.explore(PIXELS, how="fovea", shifts=3, seed=1)
    assert path.compare(path)["sequence score"].scanpath == 1
    same = path.compare([path.as_fixations("a.png"), path])
    assert same["edit distance"] == (0, 0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ActivePerception.recommended(grid=(0, 10)), "grid: expected a whole number from 1"),
        (lambda: ActivePerception.recommended(grid=10), r"grid: expected \(columns, rows\), got 10"),
        (lambda: ActivePerception.recommended("yolo"), "unknown detector 'yolo'; did you mean 'yolov3'"),
        (lambda: ActivePerception.recommended("mine.weights"), "detector: expected a cfg and its weights"),
        (lambda: ActivePerception.published(sensor="gradual"), "unknown published sensor 'gradual'"),
        (lambda: ActivePerception.raw(sensor="wide"), "unknown sensor 'wide'"),
        (lambda: check_detector("nosuch.onnx"), r"detector: no such file: nosuch\.onnx; check the path"),
    ],
)
def test_invalid_arguments_of_presets_are_refused_with_the_remedy(call, message):
    with pytest.raises(SemfovError, match=f"^{message}"):
        call()


def test_learned_models_accept_only_grids_of_similar_size():
    """A grid may have from half to twice the columns and rows that a model was fitted on."""
    model = Verification.from_pretrained("yolov3-tiny")
    settings = {"detector": model.metadata["detector"], "sensor": model.metadata["sensor"]}
    for grid in ((10, 10), (20, 20), (5, 5), (16, 12)):
        model.check_compatible(settings, grid)
    for grid in ((21, 10), (10, 4), (40, 40), (1, 1)):
        with pytest.raises(SemfovError, match=r"^grid: the .* was fitted on 10 × 10 cells.*use grid=\(10, 10\)"):
            model.check_compatible(settings, grid)


@pytest.mark.parametrize("kind", ["array", "tensor", "floats", "Pillow image"])
def test_pictures_in_the_order_of_opencv_have_the_same_colours(kind):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (12, 17, 3), dtype=np.uint8)
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    given = {
        "array": bgr,
        "tensor": torch.from_numpy(bgr),
        "floats": torch.from_numpy(bgr).permute(2, 0, 1) / 255,
        "Pillow image": Image.fromarray(rgb),  # knows its own order
    }[kind]
    expected = torch.from_numpy(rgb).permute(2, 0, 1)
    torch.testing.assert_close(as_image(given, color="bgr"), expected / 255)
    assert torch.equal(open_large(given, color="bgr").read((3, 1, 9, 12)), expected[:, 1:12, 3:9])
    with pytest.raises(SemfovError, match="bgr"):
        as_image(given, color="brg")


@pytest.mark.parametrize("model", [VOCUS2, IttiKoch])
def test_saliency_takes_pictures_of_any_type(tmp_path, model):
    picture = Image.fromarray(np.random.default_rng(0).integers(256, size=(48, 64, 3), dtype=np.uint8))
    picture.save(tmp_path / "a.png")
    expected = model()(read_image(tmp_path / "a.png")[None])
    for source in (tmp_path / "a.png", str(tmp_path / "a.png"), picture, np.asarray(picture)):
        assert torch.equal(model()(source), expected)


@pytest.mark.parametrize("cells", [[], [0, 100], [0, -1], [0, 2.5], ["a"]])
def test_cells_that_an_episode_cannot_look_at_are_refused(cells, agent):
    with pytest.raises(SemfovError, match=r"^cells: expected "):
        semfov.agents.fovea_episode.GazePlan(agent.fovea, cells=cells)


NAMED = {
    "agent": ActivePerception,
    "decision": Decision,
    "gaze": GazePrediction,
    "live": LivePerception,
    "moment": WindowMoment,
    "objects": Objects,
    "record": Scanpath,
}


@pytest.mark.parametrize("table", ["AGENT", "DECISION", "GAZE_PREDICTION", "LIVE", "OBJECTS", "PACKAGE", "RECORD"])
def test_what_a_hint_names_is_there(table, agent):
    """Every attribute in the words for others' words is one of the class."""
    text = "\n".join({*getattr(attribute_words, table).values(), *words.MAKERS.values()})
    names = re.findall(rf"\b({'|'.join(NAMED)})\.(\w+)", text)
    assert names
    absent = [
        f"{owner}.{name}"
        for owner, name in names
        if not hasattr(agent if owner == "agent" else NAMED[owner], name)
        and name not in getattr(NAMED[owner], "__dataclass_fields__", ())
    ]
    assert absent == []
    assert [name for name in re.findall(r"semfov\.(\w+)", text) if not hasattr(semfov, name)] == []
