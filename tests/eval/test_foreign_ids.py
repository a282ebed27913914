"""The image ids of annotations do not affect where a run writes."""

import json
from pathlib import Path

import pytest

from eval.search import main
from semfov.data.scenes import EmbeddedScenes

pytestmark = [pytest.mark.weights, pytest.mark.slow]

IDS = ["/../../../x/evil", "../up", "a/b", "a-b", "..", "x" * 300]


def test_a_run_writes_only_into_its_folders_whatever_the_image_ids_are(tmp_path):
    from PIL import Image

    embedded = EmbeddedScenes(("person", "cat", "cup", "motorcycle"), count=len(IDS))
    root, rows = tmp_path / "root", {"images": [], "annotations": [], "categories": []}
    root.mkdir()
    rows["categories"] = [{"id": n, "name": name} for n, name in enumerate(embedded.classes, 1)]
    for index, identity in enumerate(IDS):
        scene = embedded[index]
        pixels = (scene.image.permute(1, 2, 0) * 255).byte().numpy()
        Image.fromarray(pixels).save(root / f"{index}.png")
        rows["images"].append({"id": identity, "file_name": f"{index}.png", "width": 640, "height": 480})
        for box, label in zip(scene.boxes.tolist(), scene.labels.tolist(), strict=True):
            bbox = [box[0], box[1], box[2] - box[0], box[3] - box[1]]
            entry = {"id": len(rows["annotations"]), "image_id": identity, "category_id": label, "bbox": bbox}
            rows["annotations"].append(entry)
    (tmp_path / "instances.json").write_text(json.dumps(rows))
    before = set(tmp_path.rglob("*"))
    out = tmp_path / "deep" / "er" / "out"
    arguments = ["--data.root", str(root), "--data.annotations", str(tmp_path / "instances.json"), "--workers", "1"]
    arguments += ["--data.min_instances", "0", "--belief.columns", "3", "--belief.rows", "2", "--scanpaths", "6"]
    arguments += ["--protocol.starts", "1", "--protocol.shifts", "2", "--policies", '["random"]', "--out", str(out)]
    assert main([*arguments, "--cache", str(tmp_path / "cache")]) == 0
    written = {path for path in tmp_path.rglob("*") if path.is_file()} - before
    assert all(path.is_relative_to(out) or path.is_relative_to(tmp_path / "cache") for path in written)
    pictures = [path for path in written if path.name.startswith("scanpath_")]
    assert len(pictures) == len(IDS), "every picture has its own file"
    assert {path.parent for path in pictures} == {out}
    assert not Path("/x/evil").exists()
