"""The package as a whole: what it exports, what importing it costs, which way imports run."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import semfov

PACKAGE = Path(semfov.__file__).parent

SURFACE = {
    "ActivePerception",
    "CocoScenes",
    "DataError",
    "Detections",
    "Detector",
    "DirichletBelief",
    "DirichletStatistics",
    "EmbeddedScenes",
    "Evidence",
    "Eye",
    "FovealObservationModel",
    "Foveation",
    "Grid",
    "InputError",
    "Scanpath",
    "Selection",
    "SemanticMap",
    "SemfovError",
    "TargetEvidence",
    "acquisition",
    "dirichlet",
    "exploration_policy",
    "foveate",
    "fusion",
    "load_detector",
    "read_image",
    "saliency",
    "search_policy",
    "weigh",
}

# A room imports from itself and from the rooms before it.
ROOMS = ["errors", "files", "sensor", "detection", "observation", "belief", "gaze", "scanpath", "eye", "agent"]


def test_public_surface():
    assert set(semfov.__all__) == SURFACE
    for name in SURFACE:
        assert getattr(semfov, name) is not None


def test_import_is_light():
    heavy = ["kornia", "onnx", "onnxruntime", "pycocotools", "torchvision", "matplotlib", "skimage", "jsonargparse"]
    code = f"import sys, semfov; print([m for m in {heavy} if m in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


@pytest.mark.parametrize("room", ROOMS)
def test_imports_run_one_way(room):
    files = list((PACKAGE / room).rglob("*.py")) if (PACKAGE / room).is_dir() else [PACKAGE / f"{room}.py"]
    assert files
    allowed = ROOMS[: ROOMS.index(room) + 1]
    for file in files:
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [node.module] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                parts = (name or "").split(".")
                if parts[0] in ("eval", "train", "tests", "benchmarks"):
                    pytest.fail(f"{file} imports {name}")
                if parts[0] == "semfov" and len(parts) > 1:
                    assert parts[1] in allowed, f"{file} imports {name}"
