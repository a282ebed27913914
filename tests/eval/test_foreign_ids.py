"""The image ids of annotations do not affect where a run writes."""

import json
from pathlib import Path

import pytest

from eval.search import main
from tests.colours import write_home

pytestmark = pytest.mark.slow

IDS = ["/../../../x/evil", "../up", "a/b", "a-b", "..", "x" * 300]


def test_a_run_writes_only_into_its_folders_whatever_the_image_ids_are(tmp_path):
    home = write_home(tmp_path, len(IDS))
    file = home / "photographs/instances.json"
    rows = json.loads(file.read_text())
    for image, identity in zip(rows["images"], IDS, strict=True):
        image["id"] = identity
    for box in rows["annotations"]:
        box["image_id"] = IDS[box["image_id"]]
    file.write_text(json.dumps(rows))
    before = set(tmp_path.rglob("*"))
    out = tmp_path / "deep" / "er" / "out"
    arguments = ["--detector.name", str(home / "colours.onnx"), "--data.root", str(file.parent)]
    arguments += ["--data.annotations", str(file), "--data.min_instances", "0", "--workers", "1", "--scanpaths", "6"]
    arguments += ["--belief.columns", "3", "--belief.rows", "2", "--protocol.starts", "1", "--protocol.shifts", "2"]
    arguments += ["--policies", '["random"]', "--out", str(out), "--cache", str(tmp_path / "cache")]
    assert main(arguments) == 0
    written = {path for path in tmp_path.rglob("*") if path.is_file()} - before
    assert all(path.is_relative_to(out) or path.is_relative_to(tmp_path / "cache") for path in written)
    pictures = [path for path in written if path.name.startswith("scanpath_")]
    assert len(pictures) == len(IDS), "every picture has its own file"
    assert {path.parent for path in pictures} == {out}
    assert not Path("/x/evil").exists()
