"""Hand-made requests to the page of `semfov app`: no file of others, no request of the server, no end of its work."""

import json
import socket
import threading
from contextlib import closing

import pytest
from PIL import Image

from semfov.cli import app

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]  # those of Gradio and of what it imports
SECONDS = 60  # that an answer may take on a busy machine


@pytest.fixture
def client(opened):
    import httpx

    # The server closes a connection that is not used for five seconds, which is short on a busy machine.
    anew = httpx.Limits(max_keepalive_connections=0)
    with httpx.Client(base_url=opened(None), timeout=SECONDS, limits=anew) as client:
        yield client


@pytest.fixture
def listener():
    """A server that nobody should ask; returns its address, and tells at the end whether somebody did."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.5)
        yield f"http://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(TimeoutError):
            server.accept()


@pytest.fixture
def uploaded(client, photo):
    return {"path": client.post("gradio_api/upload", files={"files": photo.read_bytes()}).json()[0]}


class Visitor:
    """Calls functions of the page by requests, each as another visitor."""

    def __init__(self, client):
        self.client = client
        self.count = 0
        functions = client.get("config").json()["dependencies"]
        self.look = next(each["id"] for each in functions if len(each["inputs"]) == 5)
        self.click = next(each["id"] for each in functions if each["targets"][0][1] == "select")

    def call(self, function, data, **fields):
        """Call a function; returns the data of its answer, or an error in words."""
        self.count += 1
        name = f"visitor{self.count}"
        given = {"data": data, "fn_index": function, "session_hash": name, **fields}
        joined = self.client.post("gradio_api/queue/join", json=given)
        if joined.status_code != 200:
            return joined.text
        with self.client.stream("GET", "gradio_api/queue/data", params={"session_hash": name}) as answers:
            for line in answers.iter_lines():
                if "process_completed" in line:
                    output = json.loads(line.removeprefix("data:"))["output"]
                    return output.get("data") or output["error"]
        raise AssertionError("the answers ended before the call")


@pytest.fixture
def visitor(client):
    return Visitor(client)


def is_page(answer):
    return isinstance(answer, list) and "iframe" in str(answer)


def test_no_file_of_the_server_is_looked_at_and_nothing_is_fetched_over_http(visitor, uploaded, listener, tmp_path):
    """Gradio itself reads any file whose entry has no mark, and fetches any address of the network."""
    Image.new("RGB", (64, 64), (230, 20, 20)).save(tmp_path / "secret.png")
    assert is_page(visitor.call(visitor.look, [uploaded, "all classes", "find all", 2, ""]))
    mark = {"meta": {"_type": "gradio.FileData"}}
    for path in (str(tmp_path / "secret.png"), "/etc/passwd", f"{listener}/a.png", f"file://{tmp_path}/secret.png"):
        for entry in ({"path": path}, {"path": path, **mark}, {"path": uploaded["path"], "url": {"path": path}}):
            answer = visitor.call(visitor.look, [entry, "all classes", "find all", 2, ""])
            assert answer == "expected files that this page was given\n"
        assert visitor.client.get(f"gradio_api/file={path}").status_code == 403
    for entry in (str(tmp_path / "secret.png"), f"{listener}/a.png", [uploaded], {"url": f"{listener}/a.png", **mark}):
        assert not is_page(visitor.call(visitor.look, [entry, "all classes", "find all", 2, ""]))


def test_wrong_arguments_are_errors_over_http(visitor, uploaded):
    right = [uploaded, "all classes", "find all", 2, ""]
    wrong = {
        1: ["zebra", ["zebra"], {"a": 1}, 5],
        2: ["delete", None, ["find all"]],
        3: [0, -5, 1e300, "2", [2]],
        4: [[1], {"a": 1}, "1" * 300],
    }
    for place, values in wrong.items():
        for value in values:
            data = [*right[:place], value, *right[place + 1 :]]
            if place == 4:
                data[1:3] = "red", "search"
            assert not is_page(visitor.call(visitor.look, data)), (place, value)
    for data in ([], [uploaded]):
        assert not is_page(visitor.call(visitor.look, data))
    for index in ([1e300, 1], [1], "ab", None, [[1, 2]], {"a": 1}, [1, 2, 3]):
        answer = visitor.call(visitor.click, [uploaded, "red", None, None], event_data={"index": index})
        assert "point" in str(answer), index
    for states in ("x", [10**9]):  # which the server keeps by itself
        answer = visitor.call(visitor.click, [uploaded, "red", "x", states], event_data={"index": [3, 3]})
        assert "Look 1" in str(answer)
    for function in (-1, 999, None, "x", 2**70):
        assert not is_page(visitor.call(function, right))
    assert is_page(visitor.call(visitor.look, right))


def test_nobody_goes_past_the_queue_over_http(client, visitor, uploaded):
    """Gradio itself runs any function at once, of as many visitors as ask."""
    given = {"data": [uploaded, "all classes", "find all", 2, ""], "fn_index": visitor.look, "session_hash": "a"}
    for path in ("gradio_api/run/predict", "gradio_api/run/look", "gradio_api/call/look", "gradio_api/api/look"):
        assert client.post(path, json=given).status_code == 404
    for _ in range(20):
        client.post("gradio_api/cancel", json={"session_hash": "a", "fn_index": visitor.look, "event_id": "b"})
    assert is_page(visitor.call(visitor.look, given["data"]))


def test_uploads_stay_in_their_folder_over_http(client, visitor, photo, tmp_path):
    content = photo.read_bytes()
    names = [
        "../../evil.png",
        "/etc/evil.png",
        "a" * 300 + ".png",
        "a.vrt",
        "a.tif",
        "a.jp2",
        "é.png",
    ]
    for name in names:
        answer = client.post("gradio_api/upload", files={"files": (name, content)})
        for path in answer.json() if answer.status_code == 200 else ():
            assert path.startswith(str(tmp_path / "kept"))
            assert is_page(visitor.call(visitor.look, [{"path": path}, "all classes", "find all", 2, ""]))
    page = b"<script>alert(1)</script>"
    path = client.post("gradio_api/upload", files={"files": ("a.html", page)}).json()[0]
    shown = client.get(f"gradio_api/file={path}")
    assert shown.status_code != 200 or "attachment" in shown.headers["content-disposition"]


def test_many_files_of_one_upload_are_limited_as_one_over_http(client, monkeypatch):
    """Gradio itself limits them one by one."""
    half = b"1" * (app._MOST_BYTES // 2 + 2**16)
    assert client.post("gradio_api/upload", files=[("files", half), ("files", half)]).status_code == 413


def test_a_client_that_hangs_is_not_waited_for_over_http(client, visitor, uploaded):
    address = (client.base_url.host, client.base_url.port)
    begun = b"POST /gradio_api/queue/join HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 100\r\n\r\n{"
    hanging = [socket.create_connection(address) for _ in range(20)]
    for each in hanging:
        each.sendall(begun)
    given = {"data": [uploaded, "all classes", "find all", 2, ""], "fn_index": visitor.look, "session_hash": "gone"}
    client.post("gradio_api/queue/join", json=given).raise_for_status()  # who never asks for the answer
    answers = []
    with closing(hanging[0]):
        thread = threading.Thread(target=lambda: answers.append(visitor.call(visitor.look, given["data"])))
        thread.start()
        thread.join(SECONDS)
    for each in hanging:
        each.close()
    assert is_page(answers[0])
