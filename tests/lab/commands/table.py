"""The commands of `eval` and `train`: a small run of each, the files it writes, and what it refuses.

The small runs look at photographs of coloured squares with a network that detects them (`tests.colours`). In their
settings, `HERE` stands for the folder that `write_material` fills.
"""

import importlib
import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from semfov import FovealObservationModel
from semfov.data.fixations import Fixations, write_table
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.runs.config import DetectorConfig, SensorConfig
from semfov.runs.setup import make_eye
from semfov.zoom import GlimpseEvidence
from tests.colours import CLASSES, write_network, write_photographs
from tests.small import once

NETWORK = ("--detector.name", "HERE/colours.onnx")
PHOTOGRAPHS = ("--data.root", "HERE/photographs", "--data.annotations", "HERE/photographs/instances.json",
               "--data.min_instances", "0", "--data.limit", "4")  # fmt: skip
GRID = ("--belief.columns", "3", "--belief.rows", "2")
MODEL = "colours.safetensors"


@dataclass(frozen=True)
class Command:
    """A command and what its tests need to know about it.

    Attributes:
        settings: settings of a small run, beside the folders `out` and `cache` and the number of workers.
        files: files in `out` that have the same bytes whenever the run is repeated; empty if it is not run here.
        others: further files in `out`.
        parts: finished parts of the run, below the folder that holds `out` and `cache`; empty if it keeps none.
        same: further settings that do not change the files, by name.
        refused: wrong settings and the message about each.
        workers: whether the work can be shared by processes.
    """

    settings: tuple[str, ...] = ()
    files: tuple[str, ...] = ()
    others: tuple[str, ...] = ()
    parts: str = "out/parts/*.sqlite"
    same: dict[str, tuple[str, ...]] = field(default_factory=dict)
    refused: tuple[tuple[tuple[str, ...], str], ...] = ()
    workers: bool = True


def write_material(folder: Path) -> None:
    """Write the network, the photographs, untrained models that fit it, and fixations of people in the photographs."""
    network = write_network(folder / "colours.onnx")
    (folder / "photographs").mkdir()
    write_photographs(folder / "photographs", 8)
    settings = make_eye(DetectorConfig(str(network)), SensorConfig()).settings()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        GlimpseEvidence(3).save(folder / "zoom.safetensors")
        alpha, rates = 0.5 + torch.rand(4, 3, 4), torch.full((4, 3), 0.3)
        model = FovealObservationModel(alpha, [0.2, 0.5], CLASSES, miss_rate=rates, metadata=settings)
        model.save(folder / "observation.safetensors")
        model.presence = Presence(
            torch.tensor(0.0), torch.tensor([1.0, 0.0]), torch.full((3,), 0.5), Thresholds(0.6, 0.3)
        )
        model.save(folder / "search.safetensors")
    (folder / "people").mkdir()
    draw, viewed, record = np.random.default_rng(0), [], {}
    for number in range(4):
        with Image.open(folder / "photographs" / f"{number}.png") as picture:
            picture.resize((800, 600)).save(folder / "people" / f"{number}.png")
        points = draw.uniform(0, 599, (4, 5, 2))
        viewed += [Fixations(f"{number}.png", str(who), each, (800, 600)) for who, each in enumerate(points)]
        record[f"{number}.png"] = [
            {"x": each[:, 0].tolist(), "y": each[:, 1].tolist(), "duration_ms": [200] * 5} for each in points
        ]
    write_table(folder / "people.csv", viewed)
    (folder / "people.json").write_text(json.dumps(record))


def small_run(name: str, folder: Path, *more: str) -> Path:
    """Run the small run of a command in a folder, with more settings; returns the folder of its outcomes."""
    write_material(folder)
    module, *job = name.split()
    words = once([*job, *(word.replace("HERE", str(folder)) for word in (*COMMANDS[name].settings, *more))])
    paths = ["--out", str(folder / "out"), "--cache", str(folder / "cache"), "--workers", "1"]
    assert importlib.import_module(module).main([*words, *paths]) == 0
    return folder / "out"


COMMANDS = {
    "eval.search": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, *GRID, "--protocol.starts", "2", "--protocol.shifts", "4", "--scanpaths", "1",
                  "--policies", "[random, itti-koch, {policy: non-predictive, tempering: 0.25}]"),
        files=("episodes.jsonl", "summary.csv"),
        others=("summary.md", "report.html", "manifest.json", "config.yaml", "cumulative_performance.png"),
        same={"no store": ("--store", "false"), "small batches": ("--protocol.batch", "2")},
        refused=(
            (("--policies", '["predicitve-raw"]'), "did you mean 'predictive-raw'"),
            (("--detector.name", "yolov3-tinny"), "did you mean 'yolov3-tiny'"),
        ),
    ),
    "eval.ivsn": Command(),
    "eval.explore": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, *GRID, "--protocol.starts", "2", "--protocol.shifts", "3",
                  "--policies", "[random-raw, vocus2-raw]"),
        files=("episodes.jsonl", "summary.csv"),
        others=("summary.md", "manifest.json", "config.yaml", "success_rate_all_classes.png"),
        same={"no store": ("--store", "false"), "small batches": ("--protocol.batch", "1")},
        refused=(
            (("--policies", '["kl-row"]'), "did you mean 'kl-raw'"),
            (("--policies", '["random"]'), "random-raw"),
            (("--policies", "[{policy: kl, tempering: 0}]"), "policies[0].tempering: expected a number above 0"),
        ),
    ),
    "eval.decide": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, *GRID, "--belief.search_model", "HERE/search.safetensors",
                  "--protocol.shifts", "3"),
        files=("episodes.jsonl", "decisions.md"),
        others=("manifest.json", "config.yaml", "roc.png"),
        refused=(
            (("--data.max_target_area", "1e-9", "--data.limit", "1", "--belief.columns", "2", "--belief.rows", "2"),
             "raise data.max_target_area"),
        ),
    ),
    "eval.chain": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, *GRID, "--belief.model", "HERE/observation.safetensors",
                  "--protocol.starts", "1", "--protocol.shifts", "3", "--steps", "2", "--looks", "2"),
        files=("records.jsonl", "chain.md"),
        others=("search.safetensors", "fold-0.safetensors"),
        parts="out/fold-*/parts/*.sqlite",
        refused=((("--folds", "1"), "folds: expected a whole number from 2"),),
    ),
    "eval.prior": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--commonest", "2", "--drawn", "1", "--max_target_area", "0.5",
                  "--windows", "HERE/zoom.safetensors"),
        files=("records.jsonl", "prior.md"),
        refused=((("--commonest", "0"), "commonest: expected a whole number from 1"),),
    ),
    "eval.calibration": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--fixations", "1", "--grid", "[3,2]", "--target_area", "0.5",
                  "--model", "HERE/observation.safetensors",
                  "--search_model", "HERE/search.safetensors", "--map_model", "HERE/observation.safetensors"),
        files=("beliefs.md", "beliefs.csv", "beliefs.json"),
        others=("calibration.md", "config.yaml", "manifest.json", "reliability.png", "beliefs.png"),
    ),
    "eval.figures": Command(
        refused=(
            (("--target", "cupp"), "did you mean 'cup'"),
            (("--picture", "nothing.jpg"), "nothing.jpg"),
            (("--start", "[10,0]"), "start"),
        ),
        workers=False,
    ),
    "eval.head": Command(refused=tuple(
            ((f"--{name}", value), f"{name}: expected")
            for name, value in (("width", "3"), ("dwell", "0"), ("passes", "0"), ("seconds", "0"))
        ),
    ),
    "eval.zoom": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--mosaics", "2", "--columns", "2", "--rows", "2", "--tile", "64",
                  "--slice", "64", "--passes", "4", "--model", "HERE/zoom.safetensors"),
        files=("records.jsonl", "zoom.md"),
        same={"no store": ("--store", "false")},
        refused=(
            (("--passes", "1"), "passes: expected a whole number from 2"),
            (("--overlap", "1"), "overlap: expected a number from 0 to 0.9"),
            (("--tile", "0"), "tile: expected a whole number from 16"),
            (("--seed", "-1"), "seed: expected"),
            (("--mosaics", "-1"), "mosaics: expected"),
            (("--folds", "2"), "folds: expected 0, or 2 or more with mosaics 0, got 2"),
        ),
    ),
    "eval.stream": Command(
        refused=(
            (("--target", "cupp"), "did you mean 'cup'"),
            (("--frames", "8"), "frames: expected 8 or more after frame 8"),
            (("--film", "nowhere"), "film nowhere: expected pictures in img1"),
            (("--width", "8"), "width: expected a whole number from 64"),
        ),
        workers=False,
    ),
    "eval.human viewing": Command(refused=((("--fixations", "[nobody.csv]", "--pictures", "[.]"), "nobody.csv"),)),
    "eval.human unlike": Command(
        refused=(
            (("--fitted", "[nowhere]", "--others", "."), "nowhere"),
            (("--fitted", "[.]", "--others", ".", "--count", "1"), "count: expected a whole number from 2"),
        ),
    ),
    "eval.human search": Command(refused=((("--people", "nobody.json"), "nobody.json"),)),
    "train.fit_fom": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--fixations", "4", "--holdout", "2", "--shard", "1", "--method", "newton"),
        files=(MODEL, "report.md"),
        others=("manifest.json", "reliability.png"),
        parts="cache/samples/*/*/*.safetensors",
        same={"other shards": ("--shard", "3")},
    ),
    "train.fit_search": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--model", "HERE/observation.safetensors", "--columns", "3", "--rows", "2",
                  "--looks", "3", "--holdout", "2", "--steps", "4", "--max_target_area", "0.5"),
        files=(MODEL, "judged.json", "report.md"),
        parts="cache/looks/*/*/*.safetensors",
        refused=(
            (("--holdout", "1"), "holdout: expected a whole number from 2 to"),
            (("--looks", "1"), "looks: expected a whole number from 2 to"),
        ),
    ),
    "train.fit_verification": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--columns", "3", "--rows", "2", "--looks", "3", "--folds", "2",
                  "--search_model", "HERE/search.safetensors", "--place", "0.05", "--stop_below", "0.0005"),
        files=(MODEL, "judged.json", "report.md"),
        parts="cache/looks/*/*/*.safetensors",
        workers=False,
        refused=((("--data.limit", "2", "--folds", "5"), "expected at least 5 photographs"),),
    ),
    "eval.closer": Command(
        settings=(*NETWORK, *PHOTOGRAPHS, "--columns", "3", "--rows", "2", "--looks", "3", "--folds", "2",
                  "--search_model", "HERE/search.safetensors"),
        files=("report.md",),
        parts="cache/looks/*/*/*.safetensors",
        workers=False,
    ),
    "eval.ivsn.fit": Command(workers=False),
    "train.fit_zoom": Command(refused=((("--steps", "0"), "steps: expected a whole number from 1"),)),
    "semfov.cli.main fit": Command(
        settings=("HERE/colours.onnx", *PHOTOGRAPHS, "--data.limit", "8", "--columns", "3", "--rows", "2",
                  "--holdout", "4", "--steps", "4", "--fixations", "2",
                  "--sensor.sigma", "60", "--sensor.growth", "1"),
        files=("search.safetensors", "observation.safetensors"),
        others=("manifest.json", "report.md", "search.png"),
        parts="cache/looks/*/*/*.safetensors",
        refused=(
            ((), "model: expected the name or the file of a detector, got none"),
            (("a.onnx", "--detector.name", "yolov3"), "detector.name: expected nothing, as model already names"),
        ),
    ),
}  # fmt: skip
RUN = [name for name, command in COMMANDS.items() if command.files]
