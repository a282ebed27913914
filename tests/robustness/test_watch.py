"""What the fuzzer watches is seen, and pictures of a few kinds do none of it."""

import mmap
import os
import socket
import struct
import subprocess
import sys
import threading

import pytest

from benchmarks.fuzz.resources import resources
from benchmarks.fuzz.runner import run
from benchmarks.fuzz.watch import listener, opened_files, watched
from semfov.errors import DataError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs inotify and /proc")
MOST = 64 << 20


def take_memory():
    area = mmap.mmap(-1, 48 << 20)  # from the system: Python's own heap may have as much that was freed before
    for page in range(0, len(area), mmap.PAGESIZE):
        area[page] = 1


def test_what_a_call_does_is_seen(tmp_path):
    def refuse():
        raise DataError("no picture")

    assert watched(refuse, MOST).refused == "no picture"
    assert watched(lambda: 1 / 0, MOST).fault.startswith("ZeroDivisionError")
    assert watched(take_memory, MOST).bytes > 40 << 20  # the system counts in steps
    assert watched(lambda: b"x" * (1 << 30), MOST).fault == "MemoryError: "
    assert watched(lambda: subprocess.run(["true"], check=False), MOST).forbidden
    with listener() as (address, requests):
        port = int(address.rpartition(":")[2])
        outcome = watched(lambda: socket.create_connection(("127.0.0.1", port)).sendall(b"GET /"), MOST)
        assert any("socket.connect" in event for event in outcome.forbidden)
        assert watched(lambda: None, MOST)._replace(bytes=0, seconds=0) == (None, None, 0, 0, [])
        assert len(requests) <= 1
    (tmp_path / "secret").write_text("201")
    with opened_files(tmp_path) as names:
        assert watched((tmp_path / "secret").read_text, MOST).fault is None
    assert names == {"secret"}


def test_nothing_stays_when_a_block_ends_or_fails(tmp_path):
    def descriptors():
        return len(os.listdir("/proc/self/fd"))

    threads = threading.active_count()
    before = descriptors()
    with listener():
        assert threading.active_count() == threads + 1
    with pytest.raises(KeyError), listener(), opened_files(tmp_path):
        raise KeyError
    assert threading.active_count() == threads
    assert descriptors() == before


def test_a_request_that_breaks_off_leaves_the_listener_to_the_next():
    with listener() as (address, requests):
        place = "127.0.0.1", int(address.rpartition(":")[2])
        broken = socket.create_connection(place)
        broken.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closes with a reset
        broken.close()
        with socket.create_connection(place, timeout=5) as client:
            client.sendall(b"GET /")
            assert client.recv(100).startswith(b"HTTP/1.0 404")
        assert requests == [b"GET /"]


@pytest.mark.slow
def test_pictures_stay_within_their_means():
    outcomes = run(resources, 12, 7)
    assert sum(outcomes.values()) >= 6
