"""Sdist and wheel: both are built without a network, and the wheel is installed outside the checkout."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import semfov

pytest.importorskip("hatchling", reason="needs hatchling (pip install hatchling)")
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "semfov"
DATA = {".safetensors", ".onnx", ".jpg", ".css", ".html", ".js", ".json", ".typed", ".cfg", ".txt", ".md"}

CODE = """
import socket
import sys
from pathlib import Path
from types import ModuleType

def refuse(*_, **__):
    raise AssertionError("a socket was opened")

socket.socket.connect = socket.create_connection = socket.getaddrinfo = refuse

import torch
import semfov
from semfov.cli.app import _Calls
from semfov.cli.main import main
from semfov.report.page import page_html

home = Path(semfov.__file__).parent
assert Path(sys.prefix) in home.parents, home
models = sorted(path for path in home.rglob("*.safetensors"))
assert len(models) > 15, models
semfov.FovealObservationModel.from_pretrained("yolox-nano")
semfov.FovealObservationModel.from_pretrained("yolox-nano-search")
assert "<script" in page_html("a page", [])
view = semfov.foveate(torch.rand(1, 3, 8, 8), (4.0, 4.0), sigma=2.0)
print(semfov.__version__, view.shape[-1])
assert main(["detectors"]) == 0
for words in (["search", "--target", "boat"], ["find", "--target", "person", "--passes", "4"], ["gaze"],
              ["search", "example:market", "--target", "truck", "--out", "seen"]):
    assert main(words) == 0, words
sys.modules["gradio"] = ModuleType("gradio")  # the page's calls need it only for their errors
calls = _Calls(semfov.ActivePerception.recommended())
for number, _ in enumerate(calls.examples):
    picture, name, *_ = calls.take(number, "search")
    picture.save("example.png")
    words, page = calls.look("example.png", name, "search", 2)
    print(name, words)
main(["search", "--help-all"])
"""


def run(*call, cwd, **environment):
    clean = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PIP"))}
    done = subprocess.run(
        [str(part) for part in call], cwd=cwd, env={**clean, **environment}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A folder with the sdist of the checkout and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", folder, cwd=ROOT)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder, filter="data")
    unpacked = folder / sdist.name.removesuffix(".tar.gz")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, cwd=unpacked)
    return folder


def names_in(built, kind):
    (file,) = built.glob(kind)
    if file.suffix == ".whl":
        with zipfile.ZipFile(file) as archive:
            return set(archive.namelist())
    with tarfile.open(file) as archive:
        return {name.partition("/")[2] for name in archive.getnames()}


def tracked(folder):
    """Source and data files of the package, without generated files."""
    files = [path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts]
    return {path.relative_to(ROOT).as_posix() for path in files if path.suffix in {".py", ".pyi", *DATA}}


def test_wheel_and_sdist_contain_what_they_must(built):
    every = names_in(built, "*.whl")
    assert any(name.endswith("licenses/LICENSE") for name in every)
    assert any(name.endswith("licenses/semfov/detection/models/LICENSE.txt") for name in every)
    assert {"semfov/detection/models/yolox_nano_416.onnx", "semfov/data/photographs/beach.jpg"} <= every
    names = {name for name in every if ".dist-info/" not in name}
    assert names == tracked(PACKAGE)
    assert sum(name.endswith(".safetensors") for name in names) > 15
    names = names_in(built, "*.tar.gz")
    assert {"pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md", "constraints.txt", "Makefile"} <= names
    assert {"tests/conftest.py", "eval/search/__init__.py", "train/fit_fom.py", "docs/api.py", "mkdocs.yml"} <= names
    assert not [name for name in names if name.startswith((".venv/", "build/", "runs/", ".git/"))]


def test_the_wheel_works_in_a_separate_environment_without_a_network_and_with_an_empty_cache(built, tmp_path):
    """A path file adds the dependencies of this environment, but not its editable install of the checkout.

    Whatever opens a connection ends the process.
    """
    home = tmp_path / "environment"
    venv.create(home, with_pip=False, symlinks=os.name != "nt")
    python = home / "bin" / "python"
    site = Path(run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip())
    (wheel,) = built.glob("*.whl")
    install = ["--python", python, "install", "--no-index", "--no-deps", "--no-build-isolation", "--quiet", wheel]
    run(sys.executable, "-m", "pip", *install, cwd=tmp_path)
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (site / "dependencies.pth").write_text("\n".join(sorted(libraries)) + "\n", encoding="utf-8")
    where = {"SEMFOV_CACHE": str(tmp_path / "cache"), "MPLBACKEND": "agg"}
    printed = run(python, "-W", "error", "-c", CODE, cwd=tmp_path, **where)
    assert printed.split()[:2] == [semfov.__version__, "8"]
    assert "yolox-nano" in printed
    assert "looking at example:beach, which comes with semfov" in printed
    assert "found boat" in printed
    assert "looking at example:sheet" in printed
    assert "found truck" in printed
    assert "--stop_below" in printed
    assert (tmp_path / "seen").is_dir()
    assert not (tmp_path / "cache").exists()
    command = home / "bin" / "semfov"
    assert run(command, "--version", cwd=tmp_path) == f"semfov {semfov.__version__}\n"
