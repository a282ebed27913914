"""File names in annotations are not trusted: only regular files below the root are read or written."""

import json
import os

import pytest
from PIL import Image

from semfov import CocoScenes, SemfovError, read_image
from semfov.data.pictures import Pictures
from semfov.io.files import check_regular, inside, plain_name, replacing
from tests.refusals import unusable


@pytest.fixture
def data(tmp_path):
    """The root folder, and a function that writes annotations of one image and opens them."""
    root = tmp_path / "root"
    root.mkdir()
    Image.new("RGB", (40, 30)).save(root / "a.png")
    Image.new("RGB", (40, 30)).save(tmp_path / "outside.png")

    def scenes(file_name="a.png", identity=1, category="cat"):
        document = {
            "images": [{"id": identity, "file_name": file_name, "width": 40, "height": 30}],
            "categories": [{"id": 1, "name": "cat"}, {"id": 2, "name": category}],
            "annotations": [{"id": 1, "image_id": identity, "category_id": 1, "bbox": [1, 1, 9, 9]}],
        }
        path = tmp_path / "instances.json"
        path.write_text(json.dumps(document))
        return CocoScenes(root, path, ("cat",), min_instances=0)

    return root, scenes


@pytest.mark.parametrize(
    "name",
    ["../outside.png", "sub/../../outside.png", "link.png", "folder/outside.png", "/absolute", "./../outside.png"],
)
def test_files_outside_the_root_are_refused(data, name):
    root, scenes = data
    (root / "link.png").symlink_to(root.parent / "outside.png")
    (root / "folder").symlink_to(root.parent)
    absolute = str(root.parent / "outside.png")
    unusable("leads out of it", scenes, absolute if name == "/absolute" else name)


def test_links_inside_the_root_and_to_the_root_are_followed(data, tmp_path):
    root, scenes = data
    (root / "link.png").symlink_to("a.png")
    assert scenes("link.png")[0].size == (40, 30)
    (tmp_path / "moved").symlink_to(root)
    found = CocoScenes(tmp_path / "moved", tmp_path / "instances.json", ("cat",), min_instances=0)
    assert found[0].size == (40, 30)


def test_a_folder_of_links_to_photographs_is_read_and_names_that_lead_out_are_not(data):
    root, _ = data
    (root / "link.png").symlink_to(root.parent / "outside.png")
    (root / "up").symlink_to(root.parent)
    assert Pictures(root, ["link.png"], ())[0].size == (40, 30)
    for name in ("../outside.png", "up/../outside.png", str(root.parent / "outside.png"), "."):
        unusable("leads out of it", Pictures, root, [name], ())


@pytest.mark.parametrize("kind", ["pipe", "device", "folder"])
def test_pipes_devices_and_folders_are_refused_before_they_are_read(data, tmp_path, kind):
    root, scenes = data
    path = root / "odd.png"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    else:
        path = root / "zero"
        try:
            os.mknod(path, 0o600 | 0o020000, os.makedev(1, 5))
        except PermissionError:
            pytest.skip("may not make devices")
    unusable(f"expected a file, got a {kind}", scenes, path.name)
    unusable(f"expected a file, got a {kind}", read_image, path)
    unusable(f"expected a file, got a {kind}", check_regular, path)


@pytest.mark.parametrize("text", ["a\0b", "a\ud800", "a\nb", "\x1b[31m"])
def test_control_characters_in_annotations_are_refused(data, text):
    _, scenes = data
    for arguments in ({"identity": text}, {"file_name": text}, {"category": text}):
        unusable(r"expected (id|file_name|name) to be .* without control characters, got '", scenes, **arguments)


@pytest.mark.parametrize("name", ["../a", "/a", "b/../../a", "", ".", "..", "a\0", "link/a", "x" * 5000])
def test_names_outside_the_folder_are_refused(tmp_path, name):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(SemfovError), replacing(inside(folder, name)) as temporary:
        temporary.write_text("")
    assert [path.name for path in tmp_path.rglob("*")] == ["out", "link"]


@pytest.mark.parametrize("text", ["/../../../x/evil", "..", "", "a" * 1000, "ä/ö", "con\0", "-rf", ".hidden", "a\\b"])
def test_cleaned_names_give_files_in_the_folder(tmp_path, text):
    path = inside(tmp_path, f"{plain_name(text)}.png")
    assert path.parent == tmp_path
    path.write_text("")
    assert list(tmp_path.iterdir()) == [path]
