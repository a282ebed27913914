"""The documentation site, built once for all workers of a test run."""

import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

import semfov
from semfov.detection.weights import fetch

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def can_run() -> bool:
    """Whether the weights of the default detector, which the tutorials need, are available."""
    try:
        fetch("yolov3-tiny")
    except semfov.DataError:
        return False
    return True


@pytest.fixture(scope="session")
def site(can_run: bool, tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """The folder of the built site; tutorials are executed if their detector is available."""
    folder = tmp_path_factory.getbasetemp()
    shared = folder.parent if hasattr(request.config, "workerinput") else folder
    said = shared / "site.txt"
    with FileLock(shared / "site.lock"):
        if not said.exists():
            call = [sys.executable, "-m", "docs.site", *([] if can_run else ["--skip-tutorials"])]
            done = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False)
            said.write_text(f"{done.returncode}\n{done.stdout}{done.stderr}", encoding="utf-8")
    code, _, text = said.read_text(encoding="utf-8").partition("\n")
    assert code == "0", text
    return ROOT / "build" / "site"
