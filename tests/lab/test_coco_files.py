import hashlib
import io
import json
import re
import shutil
import socket
import stat
import threading
import zipfile
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest

from semfov.errors import DataError
from tests.refusals import refused, unusable
from train import coco
from train.coco import _SPLITS, _Archive, _download_coco, _fetch_archive, _fetch_split, _unpack_members, main

NAMES = [f"{n:012d}.jpg" for n in (139, 285, 632)]


def zipped(members):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


INSTANCES = json.dumps({"images": [{"file_name": name} for name in NAMES]})
PICTURES = {f"val2017/{name}": np.random.default_rng(i).bytes(40_000) for i, name in enumerate(NAMES)}
FILES = {
    "/zips/val2017.zip": zipped({"val2017/": b""} | PICTURES),
    "/annotations/annotations_trainval2017.zip": zipped(
        {"annotations/instances_val2017.json": INSTANCES, "annotations/captions_val2017.json": "{}"}
    ),
}
ARCHIVES = {p: _Archive(p.lstrip("/"), len(data), hashlib.sha256(data).hexdigest()) for p, data in FILES.items()}
IMAGES, ANNOTATIONS = ARCHIVES.values()


class Server(ThreadingHTTPServer):
    """Serves FILES; `stop_after` cuts off each response, and `ranges` tells whether range requests are supported."""

    daemon_threads = True

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files = dict(FILES)
        self.stop_after = None
        self.status = None
        self.ranges = True
        self.requests = []

    @property
    def address(self):
        return f"http://127.0.0.1:{self.server_port}"


class Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        start = int(re.fullmatch(r"bytes=(\d+)-", self.headers["Range"])[1])
        self.server.requests.append((self.path, start))
        data = self.server.files.get(self.path)
        if self.server.status or data is None:
            self.send_error(self.server.status or 404)
            return
        if self.server.ranges:
            data = data[start:]
            self.send_response(206)
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data[: self.server.stop_after])

    def log_message(self, *_):
        pass


@pytest.fixture
def server():
    server = Server()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.fixture
def unreachable_address():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return f"http://127.0.0.1:{port}"


def get(root, address, *, keep=False):
    _fetch_split("val2017", root, IMAGES, ANNOTATIONS, address=address, keep=keep, pause=0)


def tree(root):
    return sorted(str(path.relative_to(root)) for path in root.rglob("*") if path.is_file())


WHOLE = sorted(["annotations/instances_val2017.json", *PICTURES])


def test_archives_are_fetched_verified_and_unpacked(server, tmp_path):
    get(tmp_path / "new" / "coco", server.address)
    root = tmp_path / "new" / "coco"
    assert tree(root) == WHOLE
    assert (root / "annotations/instances_val2017.json").read_text() == INSTANCES
    assert all((root / name).read_bytes() == content for name, content in PICTURES.items())
    before = len(server.requests)
    get(root, server.address)
    assert len(server.requests) == before  # nothing was missing


def test_interrupted_transfers_continue_where_they_stopped(server, tmp_path):
    server.stop_after = 50_000
    get(tmp_path, server.address, keep=True)
    starts = [start for path, start in server.requests if path == "/zips/val2017.zip"]
    assert starts == [0, 50_000, 100_000]
    assert (tmp_path / "val2017.zip").read_bytes() == FILES["/zips/val2017.zip"]
    assert tree(tmp_path) == sorted([*WHOLE, "val2017.zip", "annotations_trainval2017.zip"])


def test_a_later_run_resumes_the_transfer(server, tmp_path):
    server.stop_after = 0
    (tmp_path / "val2017.zip.part").write_bytes(FILES["/zips/val2017.zip"][:70_000])
    with pytest.raises(DataError, match=r"failed at 70,000 of [\d,]+ bytes \(the connection closed early\); run again"):
        _fetch_archive(IMAGES, tmp_path, address=server.address, pause=0)
    assert (tmp_path / "val2017.zip.part").stat().st_size == 70_000
    server.stop_after = None
    assert _fetch_archive(IMAGES, tmp_path, address=server.address).read_bytes() == FILES["/zips/val2017.zip"]
    assert server.requests[-1][1] == 70_000


def test_a_server_without_range_requests_sends_the_whole_file(server, tmp_path):
    server.ranges = False
    (tmp_path / "val2017.zip.part").write_bytes(b"x" * 70_000)
    assert _fetch_archive(IMAGES, tmp_path, address=server.address).read_bytes() == FILES["/zips/val2017.zip"]


def test_content_that_is_changed_or_of_another_size_is_refused(server, tmp_path):
    data = bytearray(FILES["/zips/val2017.zip"])
    data[1000] ^= 1
    server.files["/zips/val2017.zip"] = bytes(data)
    with pytest.raises(DataError, match=f"expected sha256 {IMAGES.sha256}, got .*; it was deleted; run again"):
        _fetch_archive(IMAGES, tmp_path, address=server.address)
    assert tree(tmp_path) == []
    server.files["/zips/val2017.zip"] += b"more"
    unusable(r"expected [\d,]+ bytes, the server has", _fetch_archive, IMAGES, tmp_path, address=server.address)


def test_a_busy_server_is_asked_again_and_a_missing_file_is_an_error(server, tmp_path):
    with pytest.raises(DataError, match=r"/elsewhere/zips/val2017\.zip: the server answers 404"):
        _fetch_archive(IMAGES, tmp_path, address=f"{server.address}/elsewhere")
    server.status = 503
    unusable("transfer failed at 0", _fetch_archive, IMAGES, tmp_path, address=server.address, pause=0)
    assert len(server.requests) == 4  # one request for a missing file, several to a busy server


def test_without_a_network_the_error_suggests_copying_the_archive(tmp_path, unreachable_address):
    unusable(r"transfer failed at 0 .* or copy annotations_trainval2017\.zip into", get, tmp_path, unreachable_address)


def test_a_fetched_archive_is_kept_until_it_is_unpacked(server, tmp_path, monkeypatch):
    monkeypatch.setattr(coco, "_unpack_members", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        get(tmp_path, server.address)
    assert tree(tmp_path) == [".download/annotations_trainval2017.zip"]
    monkeypatch.undo()
    get(tmp_path, server.address)
    assert [path for path, _ in server.requests] == ["/annotations/annotations_trainval2017.zip", "/zips/val2017.zip"]
    assert tree(tmp_path) == WHOLE


def test_archives_copied_by_the_user_are_used_and_kept(tmp_path, unreachable_address):
    for path, data in FILES.items():
        (tmp_path / ARCHIVES[path].name).write_bytes(data)
    get(tmp_path, unreachable_address)
    assert tree(tmp_path) == sorted([*WHOLE, "val2017.zip", "annotations_trainval2017.zip"])


def test_a_wrong_archive_copied_by_the_user_is_refused_and_kept(tmp_path, unreachable_address):
    (tmp_path / "annotations_trainval2017.zip").write_bytes(FILES["/annotations/annotations_trainval2017.zip"])
    (tmp_path / "val2017.zip").write_bytes(b"something else")
    unusable(r"val2017\.zip: expected sha256 .* delete it, and run again", get, tmp_path, unreachable_address)
    assert (tmp_path / "val2017.zip").read_bytes() == b"something else"


def test_unpacking_keeps_complete_files_and_replaces_damaged_ones(tmp_path):
    (tmp_path / "val2017.zip").write_bytes(FILES["/zips/val2017.zip"])
    first, second, _ = PICTURES
    (tmp_path / "val2017").mkdir()
    (tmp_path / first).write_bytes(PICTURES[first])
    (tmp_path / second).write_bytes(PICTURES[second][:-1] + b"?")
    before = (tmp_path / first).stat().st_mtime_ns
    _unpack_members(tmp_path / "val2017.zip", tmp_path, "val2017/")
    assert all((tmp_path / name).read_bytes() == content for name, content in PICTURES.items())
    assert (tmp_path / first).stat().st_mtime_ns == before


def linked():
    """An archive whose member is a link."""
    link = zipfile.ZipInfo("val2017/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    return zipped({link: "/etc/passwd"})


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (zipped({"val2017/../../evil": b"evil"}), "unsafe name"),
        (zipped({"val2017/..\\evil": b"evil"}), "unsafe name"),
        (zipped({"val2017/C:evil": b"evil"}), "unsafe name"),
        (linked(), "holds the link"),
        (b"no zip", "damaged zip file"),
        (zipped({"train2017/a.jpg": b""}), r"expected members val2017/\*, got none"),
    ],
    ids=["outside", "outside on Windows", "a drive", "a link", "damaged", "empty"],
)
def test_archives_that_are_unsafe_damaged_or_empty_are_refused(tmp_path, content, message):
    (tmp_path / "a.zip").write_bytes(content)
    unusable(message, _unpack_members, tmp_path / "a.zip", tmp_path / "root", "val2017/")
    assert tree(tmp_path) == ["a.zip"]


def test_too_little_free_space_is_an_error_before_the_download(server, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(coco.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    unusable("free space", get, tmp_path, server.address)


def test_the_program_downloads_and_reports_errors(server, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(_SPLITS, "val2017", IMAGES)
    monkeypatch.setattr(coco, "_ANNOTATIONS", ANNOTATIONS)
    assert main(["val2017", "--root", str(tmp_path), "--address", server.address]) == 0
    assert f"data.root: {tmp_path / 'val2017'}" in capsys.readouterr().out
    assert tree(tmp_path) == WHOLE
    assert main(["val2017", "--root", str(tmp_path / "b"), "--address", f"{server.address}/no"]) == 1
    assert re.fullmatch(r"error: .*404.*\n", capsys.readouterr().err)


def test_an_interrupted_program_says_how_to_resume(tmp_path, monkeypatch, capsys):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(coco, "_fetch_split", interrupt)
    assert main(["val2017", "--root", str(tmp_path)]) == 130
    assert "same command to resume" in capsys.readouterr().err


def test_bad_arguments(tmp_path):
    refused("unknown split 'val2071'; did you mean 'val2017'", _download_coco, "val2071", tmp_path)
    refused("address", _download_coco, "val2017", tmp_path, address="file:///tmp")
    with pytest.raises(SystemExit):
        main(["val2017"])
