"""`python -m train.ask_language_model` with a stand-in server: requests, kept answers, costs and errors."""

import json
import math
import os
import signal
import subprocess
import sys
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from semfov.belief import ContextPrior
from semfov.belief.context_table import read_table
from semfov.detection.coco_classes import COCO_CLASSES
from semfov.errors import DataError, InputError
from semfov.training.chat import ChatServer
from semfov.training.questions import SHIPPED, Question, answer_values, questions_of, read_prompts
from train.ask_language_model import main

ROOT = Path(__file__).parents[2]
CLASSES = ("fork", "knife", "cow")
SAYS = {"fork": "Knives, of course.", "knife": "a fork; a table", "cow": "Nothing of the kind."}


class Server:
    """A server that answers by the words of a question; its first answers can be set in `first`."""

    def __init__(self):
        self.requests, self.headers, self.first = [], [], []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def log_message(self, *args):
                pass

            def do_POST(self):
                asked = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                outer.requests.append((self.path, asked))
                outer.headers.append(dict(self.headers))
                code, body, extra = outer.first.pop(0) if outer.first else (200, outer.answer(asked), {})
                payload = body if isinstance(body, bytes) else json.dumps(body).encode()
                self.send_response(code)
                for name, value in {**extra, "Content-Length": str(len(payload))}.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(payload)

            def do_GET(self):
                outer.requests.append((self.path, None))
                self.send_error(500)

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_address[1]}/v1"
        self.wait = 0.0
        self.thread = threading.Thread(target=self.http.serve_forever, daemon=True)
        self.thread.start()

    def answer(self, asked):
        time.sleep(self.wait)
        prompt = asked["messages"][0]["content"]
        if "top" in prompt:
            text = "At the bottom."
        else:
            text = next((said for name, said in SAYS.items() if f" {name}?" in prompt or f" {name} " in prompt), "?")
        usage = {"prompt_tokens": len(prompt.split()), "completion_tokens": 7}
        return {"model": "stand-in-1", "choices": [{"message": {"role": "assistant", "content": text}}], "usage": usage}

    def close(self):
        self.http.shutdown()
        self.http.server_close()
        self.thread.join()


@pytest.fixture
def server():
    made = Server()
    yield made
    made.close()


@pytest.fixture
def call(server, tmp_path, monkeypatch):
    monkeypatch.delenv("LANGUAGE_MODEL_KEY", raising=False)
    classes, prompts = tmp_path / "classes.txt", tmp_path / "prompts.txt"
    classes.write_text("\n".join(CLASSES))
    prompts.write_text(
        "# no question\n[beside]\nWhat is near a {name} in\na picture?\n\nAnd near the {name}?\n"
        "[height]\nIs a {name} at the top, middle or bottom?\n"
    )
    out = tmp_path / "out"
    files = ["--classes", str(classes), "--prompts", str(prompts), "--out", str(out)]
    return ["--url", server.url, "--model", "m", *files]


def output_folder(call):
    return Path(call[call.index("--out") + 1])


def test_tables_contain_the_answers(server, call, monkeypatch):
    monkeypatch.setenv("LANGUAGE_MODEL_KEY", "secret")
    assert main([*call, "--input_price", "2", "--output_price", "10"]) == 0
    assert len(server.requests) == 9
    for path, asked in server.requests:
        assert path == "/v1/chat/completions"
        assert asked["model"] == "m"
        assert asked["temperature"] == 0
        assert [message["role"] for message in asked["messages"]] == ["user"]
    assert {headers["Authorization"] for headers in server.headers} == {"Bearer secret"}
    table = read_table(output_folder(call) / "beside.csv")
    assert table.rows == table.columns == CLASSES
    expected = [[None, 1, 0], [1, None, 0], [0, 0, None]]
    for row, line in zip(table.values.tolist(), expected, strict=True):
        assert [None if math.isnan(value) else value for value in row] == line
    heights = read_table(output_folder(call) / "heights.csv")
    assert heights.columns == ("top", "middle", "bottom")
    assert (heights.values[:, 2] > heights.values[:, 0]).all()
    report = (output_folder(call) / "report.md").read_text()
    prompts = sum(len(asked["messages"][0]["content"].split()) for _, asked in server.requests)
    assert f"{(2 * prompts + 10 * 63) / 1e6:.4g}" in report
    assert "stand-in-1" in report
    everything = "".join(path.read_text() for path in output_folder(call).iterdir())
    assert "secret" not in everything
    prior = ContextPrior.from_table(output_folder(call) / "beside.csv", CLASSES, source="test",
                                    places=output_folder(call) / "heights.csv")  # fmt: skip
    assert prior.cooccurrence[1, 2, 0] > 0 > prior.cooccurrence[1, 3, 0]


def test_a_question_is_not_asked_twice(server, call):
    assert main(call) == 0
    first = (output_folder(call) / "beside.csv").read_bytes(), (output_folder(call) / "answers.jsonl").read_bytes()
    assert main([*call, "--parallel", "3"]) == 0
    assert len(server.requests) == 9
    assert (
        (output_folder(call) / "beside.csv").read_bytes(),
        (output_folder(call) / "answers.jsonl").read_bytes(),
    ) == first
    # A question with another length of answers is a new question.
    assert main([*call, "--tokens", "5"]) == 0
    assert len(server.requests) == 18


@pytest.mark.slow
def test_a_killed_command_resumes_with_the_kept_answers(server, call):
    server.wait = 0.3
    command = [sys.executable, "-m", "train.ask_language_model", *call]
    process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE)
    answers = output_folder(call) / "answers.jsonl"
    while not answers.exists() or answers.read_bytes().count(b"\n") < 2:
        assert process.poll() is None, process.stderr.read()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    kept = answers.read_bytes()
    whole = kept.count(b"\n")
    assert 2 <= whole < 9
    # As after a power failure: the last line is incomplete.
    answers.write_bytes(kept + b'{"key": "abc", "ans')
    server.wait, before = 0.0, len(server.requests)
    assert main(call) == 0
    assert len(server.requests) - before == 9 - whole
    lines = answers.read_text().splitlines()
    assert len(lines) == 9
    assert len({json.loads(line)["key"] for line in lines}) == 9


def test_a_busy_server_is_asked_again(server):
    pauses = []
    chat = ChatServer(server.url, "m", retries=4, sleep=pauses.append)
    busy = {"error": {"message": "busy"}}
    soon, late = {"Retry-After": "7"}, {"Retry-After": "9999"}
    server.first = [(503, busy, {}), (429, busy, soon), (500, b"<html>", {}), (429, busy, late)]
    assert chat.ask("near a fork in").text == SAYS["fork"]
    assert pauses == [1.0, 7.0, 4.0, 60.0]
    server.first = [(503, busy, {})] * 5
    with pytest.raises(DataError, match=r"no answer after 5 attempts \(the last failed with: HTTP 503 \(busy\)\)"):
        chat.ask("near a fork in")


def test_an_unreachable_server_is_reported_after_retries(tmp_path):
    closed = Server()
    closed.close()
    pauses = []
    with pytest.raises(DataError, match=r"refused\); check that the server is running"):
        ChatServer(closed.url, "m", retries=2, sleep=pauses.append).ask("?")
    assert pauses == [1.0, 2.0]


def test_errors_of_the_server_are_explained(server, call, capsys):
    cases = {
        401: ({"error": {"message": "bad key"}}, "environment variable"),
        404: ({"error": "no such model"}, "whether the server has the model 'm'"),
        400: ({"error": {"message": "too long"}}, "too long"),
        200: (b"<html>hello</html>", "chat completion"),
    }
    for code, (body, message) in cases.items():
        server.first = [(code, body, {})]
        assert main(call) == 1
        assert message in capsys.readouterr().err
    for body in ({"choices": []}, {"choices": [{"message": {"content": None}}]}, [1], b"[" * 5000):
        server.first = [(200, body, {})]
        with pytest.raises(DataError, match="chat completion"):
            ChatServer(server.url, "m").ask("?")


def test_a_key_is_not_sent_to_a_redirected_address(server):
    other = Server()
    try:
        for code in (302, 307):
            server.first = [(code, {}, {"Location": f"{other.url}/chat/completions"})]
            with pytest.raises(InputError, match="redirects to another address"):
                ChatServer(server.url, "m", "secret").ask("?")
        assert other.requests == []
    finally:
        other.close()


def test_questions_stop_when_the_budget_is_spent(server, call, capsys):
    price = ["--output_price", "1000000"]
    assert main([*call, *price, "--budget", "20"]) == 1
    assert "budget: the answers have cost 21, which reaches the limit of 20" in capsys.readouterr().err
    assert len(server.requests) == 3
    assert main([*call, *price, "--budget", "1000"]) == 0
    assert len(server.requests) == 9


def test_damaged_answers_are_reported_with_their_line(server, call, capsys):
    assert main(call) == 0
    answers = output_folder(call) / "answers.jsonl"
    lines = answers.read_text().splitlines()
    for damaged in ("{}", "[]", '{"key": 1', '{"key": "a", "answer": 3, "prompt_tokens": 1, "completion_tokens": 1}'):
        answers.write_text("\n".join([lines[0], damaged, *lines[1:]]) + "\n")
        assert main(call) == 1
        assert "answers.jsonl, line 2" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("answer", "value"),
    [("7", 0.7), ("Yes.", 1.0), ("no", 0.0), ("I'd say 10 of 10", 1.0), ("12", None), ("perhaps", None), ("", None)],
)
def test_grades_are_read_from_answers(answer, value):
    got = answer_values(Question("beside", "fork", "cow", ""), answer, CLASSES)
    assert got == (None if value is None else {"cow": value})


def test_prompts_of_pairs_are_asked_once_for_each_pair(tmp_path):
    prompts = tmp_path / "p.txt"
    prompts.write_text("[beside]\nIs a {name} near a {other}?\n\n[height]\nIs a {name} at the {height}?\n")
    questions = questions_of(read_prompts(prompts), CLASSES)
    texts = [question.text for question in questions]
    assert texts[:3] == ["Is a fork near a knife?", "Is a fork near a cow?", "Is a knife near a cow?"]
    assert len(texts) == 3 + 9
    assert answer_values(questions[-1], "3", CLASSES) == {"bottom": 0.3}


def test_prompts_of_the_package_give_questions_for_every_class():
    questions = questions_of(read_prompts(SHIPPED), COCO_CLASSES)
    assert len(questions) == 80 * len({question.text.replace(question.name, "") for question in questions[::80]})
    assert {question.section for question in questions} == {"beside", "height"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("What?", r"\[beside\] or \[height\] before"),
        ("[near]\nWhat is near {name}?", r"got \[near\]"),
        ("[beside]\nWhat?", r"expected the placeholder \{name\}"),
        ("[beside]\nIs {name} at {height}?", r"expected the placeholder \{name\}"),
        ("[beside]\nIs {name} {", "braces"),
        ("[height]\nIs {name} at {height}?", "got none"),
    ],
)
def test_invalid_prompts_are_refused(tmp_path, text, message):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(DataError, match=message):
        read_prompts(tmp_path / "p.txt")


def test_invalid_settings_are_refused(server):
    with pytest.raises(InputError, match="url"):
        ChatServer("ftp://host/v1", "m")
    with pytest.raises(InputError, match="key"):
        ChatServer(server.url, "m", "two\nlines")
