import hashlib
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from semfov.detection import weights
from semfov.detection.weights import Weights, cache_folder, fetch
from semfov.errors import DataError, InputError

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
        entry = Weights("x.weights", len(CONTENT), hashlib.sha256(CONTENT).hexdigest(), "public domain", sources)
        monkeypatch.setitem(weights.WEIGHTS, "x", entry)

    return register


def test_weights_are_fetched_only_once(cache, register):
    source = Source()
    register(source)
    path = fetch("x")
    assert path == cache / "x.weights"
    assert path.read_bytes() == CONTENT
    assert fetch("x") == path
    assert len(source.calls) == 1
    assert list(cache.iterdir()) == [path]


def test_sources_are_tried_in_order(cache, register):
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


def test_a_file_without_a_source_is_asked_for(cache):
    with pytest.raises(DataError) as caught:
        fetch("nanodet-plus-m-1.5x")
    for part in ("no source", "RangiLyu/nanodet/releases", "nanodet-plus-m-1.5x_416.onnx", "weights=", str(cache)):
        assert part in str(caught.value)


def test_unknown_names_are_refused_with_a_suggestion():
    with pytest.raises(InputError, match="did you mean 'yolov3-tiny'"):
        fetch("yolo3-tiny")


def test_cache_folder(cache, monkeypatch):
    assert cache_folder() == cache
    monkeypatch.delenv("SEMFOV_CACHE")
    assert "semfov" in str(cache_folder())


@pytest.mark.weights
def test_published_file_has_the_known_digest(tiny_weights):
    assert hashlib.sha256(tiny_weights.read_bytes()).hexdigest().startswith("dccea06f59b781ec")
