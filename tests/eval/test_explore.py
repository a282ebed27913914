"""`python -m eval.explore` as a user runs it: small, on the embedded scenes, with the real detector."""

import csv
import json
from dataclasses import replace

import pytest
import torch

from eval.comparison import saliency as saliency_store
from eval.comparison.saliency import SaliencyStore, saliency_map, saliency_table
from eval.explore import explore
from eval.explore.run import FUSED, PAINTED, ExploreConfig, ExploreRun
from semfov import Grid, observers
from semfov.gaze.saliency import VOCUS2, FixationDensity
from semfov.io.code import _closure
from semfov.runs.config import DetectorConfig
from tests.refusals import refused
from tests.small import run_settings


@pytest.fixture(scope="session")
def small(tmp_path_factory):
    """A run of two scenes on 4 × 3 cells."""
    settings = run_settings(tmp_path_factory.mktemp("explore"), 2, starts=2, shifts=4)
    return ExploreConfig(**settings, policies=("random-raw", "kl-calibrated", "vocus2-raw"))


@pytest.fixture(scope="session")
def finished(small):
    """The small run, finished."""
    explore(small)
    return small


def count_right_by_loop(run: ExploreRun, record: dict) -> tuple[list[int], list[int], list[int], int]:
    """Right answers after each gaze shift, with a new observer and loops over cells and objects."""
    index = run.scenes.ids.index(record["scene"])
    scene, grid, looks = run.scenes[index], run.grid(index), run.detections(index)
    observation = run.models.observation if record["policy"].endswith("calibrated") else None
    observer = observers.Semantic(len(run.scenes.classes) + 1, observation)
    belief = observer.start(1, grid, looks.scores)
    kinds: tuple[list[int], ...] = [], [], []
    holds = grid.footprint(scene.boxes)
    objects = [{int(label) for label, there in zip(scene.labels, holds[:, c], strict=True) if there} for c in range(12)]
    for cell in record["cells"]:
        belief = observer(belief, looks[torch.tensor([cell])], grid.centres[cell][None], grid)
        counts = [0, 0, 0]
        for place, classes in enumerate(objects):
            p = belief.probabilities[0, place]
            known = bool((p != p[0]).any())
            counts[0] += known and int(p.argmax()) in classes
            counts[1] += known and int(p[1:].argmax()) + 1 in classes
            counts[2] += known and int(p.argmax()) in (classes or [0])
        for kind, count in zip(kinds, counts, strict=True):
            kind.append(count)
    return *kinds, sum(map(bool, objects))


def test_run_writes_records_tables_and_figures(finished):
    run = ExploreRun(finished)
    records = [json.loads(line) for line in (finished.out / "episodes.jsonl").read_text().splitlines()]
    references = [record for record in records if record["policy"] in (FUSED, PAINTED)]
    assert len(records) == 2 * 2 * (3 + 2)
    assert len(references) == 2 * 2 * 2
    for record in references:
        assert record["cells"] == []
        assert len({*record["right"]}) == 1
    for record in records:
        if record in references:
            continue
        assert record["start"] == record["cells"][0]
        assert len(set(record["cells"])) == 5
        counts = (record[name] for name in ("right", "right_without_background", "right_everywhere"))
        assert (*counts, record["object_cells"]) == count_right_by_loop(run, record)
    with (finished.out / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * (3 + 2) * 5
    assert any(record["right"][-1] > 0 for record in records)
    for row in rows:
        field, cells = {
            "all classes": ("right", "object_cells"),
            "without background": ("right_without_background", "object_cells"),
            "whole grid": ("right_everywhere", "grid_cells"),
        }[row["answers"]]
        by_scene = {}
        for record in records:
            if record["policy"] == row["policy"]:
                rate = record[field][int(row["shifts"])] / record[cells]
                by_scene.setdefault(record["scene"], []).append(rate)
        expected = sum(sum(rates) / len(rates) for rates in by_scene.values()) / len(by_scene)
        assert float(row["success_rate"]) == pytest.approx(expected, abs=1e-6)
    manifest = json.loads((finished.out / "manifest.json").read_text())
    assert manifest["command"][2] == "eval.explore"
    assert not any("millisecond" in name for name in manifest)
    assert {path.name for path in finished.out.glob("*.png")} == {
        "success_rate_all_classes.png",
        "success_rate_without_background.png",
        "success_rate_whole_grid.png",
    }
    assert "kl-calibrated" in (finished.out / "summary.md").read_text()


def test_saliency_is_computed_from_the_foveated_image(finished):
    run = ExploreRun(finished)
    image, grid = run.scenes[0].image, run.grid(0)
    stored = run.saliency("vocus2", 0)
    assert stored.shape == (12, 12)
    sensor, scale = run.eye.sensor, 640 / max(image.shape[-2:])
    with torch.inference_mode():
        size = [round(n * scale) for n in image.shape[-2:]]
        large = torch.nn.functional.interpolate(image[None], size, mode="bilinear")
        seen = VOCUS2()(sensor(large, (grid.centres[5] + 0.5) * scale - 0.5))[0]
    peak = divmod(int(seen.argmax()), seen.shape[-1])
    peak_cell = int(peak[0] * 3 / seen.shape[0]) * 4 + int(peak[1] * 4 / seen.shape[1])
    assert stored[5].argmax() == peak_cell
    image = image[..., : 3 * (image.shape[-2] // 3), : 4 * (image.shape[-1] // 4)]  # cells of whole pixels
    grid = Grid(4, 3, (image.shape[-1], image.shape[-2]))
    picture = saliency_table(VOCUS2(), "picture", "mean", sensor, 640.0, image, grid)
    assert picture.shape == (1, 12)
    expected = VOCUS2()(image[None]).unflatten(-1, (4, -1)).unflatten(1, (3, -1)).mean((2, 4)).flatten(1)
    torch.testing.assert_close(picture, expected)
    detector = run.eye.detector
    people = saliency_table(saliency_map("people", detector), "picture", "mean", sensor, 640.0, image, grid)
    density = FixationDensity.for_detector(detector)
    log = density(detector.features(image[None], [*density.layers]))
    torch.testing.assert_close(people, log.exp().unflatten(-1, (4, -1)).unflatten(1, (3, -1)).mean((2, 4)).flatten(1))


def test_a_model_of_saliency_without_a_class_is_refused(finished):
    refused(
        "unknown saliency model 'vocus'; did you mean 'vocus2'",
        saliency_map,
        "vocus",
        ExploreRun(finished).eye.detector,
    )


def test_stored_saliency_depends_neither_on_the_detector_nor_on_the_code_of_beliefs_and_policies(finished, tmp_path):
    """The input size and the threshold of the detector do not change the foveated image."""
    alone = replace(finished, policies=("vocus2-raw",))
    small = replace(alone, detector=DetectorConfig(input_size=224, threshold=0.2), cache=tmp_path, out=tmp_path)
    run, other = ExploreRun(alone), ExploreRun(small)
    assert other.store.key != run.store.key
    assert other.saliency_stores["vocus2"].key == run.saliency_stores["vocus2"].key
    assert torch.equal(other.saliency("vocus2", 0), run.saliency("vocus2", 0))
    code = {path.stem for path in _closure(saliency_store._SOURCES, lambda name: name.startswith("semfov."))}
    assert {"vocus2", "itti", "grid"} <= code
    assert not {"fusion", "belief", "config", "candidates", "choice"} & code


def test_saliency_is_stored_by_all_settings_that_affect_it(finished):
    run, folder = ExploreRun(finished), finished.cache / "saliency"
    settings = run.eye.settings()["sensor"]

    def key(name="vocus2", view="foveated", reduction="max", sensor=settings, grid=(4, 3), detector=None):
        return SaliencyStore(folder, name, view, reduction, sensor, grid, detector).key

    other = {**settings, "sigma": 50.0}
    keys = [
        key(),
        key(name="itti-koch"),
        key(view="picture"),
        key(reduction="mean"),
        key(sensor=other),
        key(grid=(3, 4)),
        key(name="people"),
        key(name="people", detector={"name": "yolox-nano"}),
    ]
    assert len(set(keys)) == len(keys)
    assert key() == run.saliency_stores["vocus2"].key
    # The whole photograph looks the same to every sensor.
    assert key(view="picture", sensor=other) == key(view="picture")
