"""Every picture enters by one door: only the readers of `semfov.data` open files of pictures."""

import ast
from pathlib import Path

import pytest

import semfov

PACKAGE = Path(semfov.__file__).parent
READERS = {  # where others' readers are called
    "PIL.Image.open": {"data/images.py", "report/overview.py"},  # the latter opens what a page has encoded
    "rasterio.open": {"data/gdal.py"},
    "tifffile.TiffFile": {"data/rasters.py", "data/tiff.py"},
    "cv2.VideoCapture": {"data/sources.py"},
}
OTHERS = {  # by which nothing is read here
    *("cv2.imread", "cv2.imreadmulti", "cv2.imdecode", "cv2.imdecodemulti", "tifffile.imread", "tifffile.TiffReader"),
    *("tifffile.memmap", "matplotlib.pyplot.imread", "matplotlib.image.imread", "skimage.io.imread"),
    *("torchvision.io.read_image", "torchvision.io.decode_image", "PIL.ImageFile.Parser", "rasterio.MemoryFile"),
}
LIBRARIES = {"imageio", "skimage.io", "pyvips", "wand", "osgeo", "openslide", "pillow_heif", "torchvision.io"}
COMPONENTS = {"gradio.Gallery", "gradio.ImageEditor", "gradio.ImageSlider", "gradio.Examples", "gradio.AnnotatedImage"}


def nodes_of(source: str) -> list[ast.AST]:
    """All nodes of the syntax tree of a module."""
    return [*ast.walk(ast.parse(source))]


def called(nodes: list[ast.AST]) -> list[tuple[str, ast.Call]]:
    """Calls in a module, by the whole names of what is called."""
    names: dict[str, str] = {}
    for node in nodes:
        if isinstance(node, ast.Import):
            for each in node.names:
                first = each.name.partition(".")[0]
                names[each.asname or first] = each.name if each.asname else first
        elif isinstance(node, ast.ImportFrom):
            names |= {each.asname or each.name: f"{node.module}.{each.name}" for each in node.names}
    calls = []
    for node in nodes:
        if isinstance(node, ast.Call):
            first, dot, rest = ast.unparse(node.func).partition(".")
            calls.append((names.get(first, first) + dot + rest, node))
    return calls


def _is_path(kind: ast.expr | None) -> bool:
    return isinstance(kind, ast.Constant) and kind.value == "filepath"


def imported(nodes: list[ast.AST]) -> set[str]:
    """Names of all imports of a module, with those of what it takes out of them."""
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {each.name for each in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{each.name}" for each in node.names)}
    return found


def other_doors(file: str, source: str) -> list[str]:
    """What a module of the package calls to read pictures that is not its to call."""
    nodes = nodes_of(source)
    found = [f"import {name}" for name in imported(nodes) for each in LIBRARIES if f"{name}.".startswith(f"{each}.")]
    for name, call in called(nodes):
        if name in OTHERS | COMPONENTS or file not in READERS.get(name, {file}):
            found.append(name)
        kinds = {each.arg: each.value for each in call.keywords}
        if name == "PIL.Image.open" and "formats" not in kinds:
            found.append(f"{name} with all formats")
        if name == "gradio.Image" and "sources" in kinds and not _is_path(kinds.get("type")):
            found.append(f"{name} that decodes")
    return found


def test_only_the_readers_open_files_of_pictures():
    modules = {str(path.relative_to(PACKAGE)): path.read_text() for path in PACKAGE.rglob("*.py")}
    doors = {file: found for file, source in modules.items() if (found := other_doors(file, source))}
    assert doors == {}
    for name in ("PIL.Image.open", "tifffile.TiffFile", "rasterio.open"):
        seen = {call for file in READERS[name] for call, _ in called(nodes_of(modules[file]))}
        assert name in seen  # it can see them


@pytest.mark.parametrize(
    "source",
    [
        "from PIL import Image\nImage.open(path, formats=('PNG',))",
        "import PIL.Image\nPIL.Image.open(path)",
        "from PIL.Image import open as read\nread(path)",
        "import cv2\ncv2.imread(path)",
        "def read(path):\n    from cv2 import imdecode\n    return imdecode(path)",
        "import imageio.v3",
        "from skimage import io",
        "import rasterio as raster\nraster.open(path)",
        "import tifffile\ntifffile.imread(path)",
        "import gradio\ngradio.Image(type='pil', sources=['upload'])",
        "import gradio\ngradio.Gallery()",
    ],
)
def test_another_door_is_seen(source):
    assert other_doors("cli/another.py", source)


def test_the_door_takes_only_some_of_the_formats_of_pillow():
    for name, call in called(nodes_of((PACKAGE / "data/images.py").read_text())):
        assert name != "PIL.Image.open" or ast.unparse(call).endswith("formats=_known_to_pillow())")
    assert {"EPS", "WMF", "EMF", "PDF", "MSP", "FITS"}.isdisjoint(semfov.data.images._known_to_pillow())
