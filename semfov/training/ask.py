"""Fill context tables with the answers of a language model."""

import hashlib
import json
import os
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor
from tqdm import tqdm

from semfov.belief.context_table import write_table
from semfov.data.classes import canonical_name, class_indices
from semfov.detection.coco_classes import COCO_CLASSES
from semfov.errors import DataError, InputError, check
from semfov.experiments.settings import Count, Positive, Settings, Weight, Whole, Workers
from semfov.experiments.setup import plain
from semfov.experiments.summary import table
from semfov.io.files import check_regular, sha256, write_text
from semfov.training.chat import ChatServer, Reply
from semfov.training.questions import HEIGHTS, SHIPPED, Question, answer_values, questions_of, read_prompts


@dataclass(frozen=True)
class AskConfig(Settings):
    """Ask a language model which objects occur together, and at which height in a picture.

    Args:
        url: address of a server with the chat-completions interface, up to and including /v1.
        model: name of the model on the server.
        key: name of the environment variable that holds the server's API key. No key is sent if it is not set.
        prompts: file with the prompts (None: the file that comes with the package).
        classes: file with one class name on each line (None: the 80 classes of COCO).
        tokens: maximum number of tokens in an answer.
        timeout: seconds to wait for an answer.
        retries: how often a question is asked again after a failure.
        parallel: number of questions that are sent at the same time.
        input_price: price of a million input tokens (questions).
        output_price: price of a million output tokens (answers).
        budget: maximum cost of all answers together. No further question is sent once it is reached (None: no limit).
        out: folder for the answers, the tables and the report.
    """

    url: str = "http://127.0.0.1:8080/v1"
    model: str = "default"
    key: str = "LANGUAGE_MODEL_KEY"
    prompts: Path | None = None
    classes: Path | None = None
    tokens: Count = 120
    timeout: Positive = 60.0
    retries: Whole = 5
    parallel: Workers = 1
    input_price: Weight = 0.0
    output_price: Weight = 0.0
    budget: Weight | None = None
    out: Path = Path("runs/ask_language_model")


def ask_language_model(config: AskConfig) -> None:
    """Ask the questions that have no answer yet, and write the answers, the tables and a report."""
    classes = read_classes(config.classes) if config.classes is not None else COCO_CLASSES
    prompts = config.prompts or SHIPPED
    questions = questions_of(read_prompts(prompts), classes)
    server = ChatServer(
        config.url,
        config.model,
        os.environ.get(config.key) or None,
        tokens=config.tokens,
        timeout=config.timeout,
        retries=config.retries,
    )
    answers = Answers(config.out / "answers.jsonl")
    keys = [key_of(server, question) for question in questions]
    ask_all(server, dict(zip(keys, questions, strict=True)), answers, config)
    known = [(question, answers.known[key]) for key, question in zip(keys, questions, strict=True)]
    beside, heights, unread = tables_of([(question, entry["answer"]) for question, entry in known], classes)
    write_table(config.out / "beside.csv", classes, classes, beside)
    written = ["answers.jsonl", "beside.csv"]
    if not heights.isnan().all():
        write_table(config.out / "heights.csv", classes, HEIGHTS, heights)
        written.append("heights.csv")
    text = report([entry for _, entry in known], unread, beside, config, sha256(prompts))
    write_text(config.out / "report.md", text)
    write_text(config.out / "config.yaml", yaml.safe_dump(plain(asdict(config)), sort_keys=False))
    print(text)
    print("written:", *(f"  {config.out / name}" for name in [*written, "report.md", "config.yaml"]), sep="\n")


class Answers:
    """A file of answers in JSON Lines format.

    Each answer is written as soon as it arrives, so a killed command loses no answer that it has received.

    Args:
        path: the file. Answers that it holds already are read.

    Raises:
        DataError: the file cannot be read, or a complete line of it is not an answer. An incomplete last line is
            removed instead.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[str, dict[str, Any]] = {}
        check_regular(path)
        if not path.exists():
            return
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
        lines = text.splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("\n")]
        for number, line in enumerate(whole, 1):
            try:
                entry = json.loads(line)
                counts = [int(entry[name]) for name in ("prompt_tokens", "completion_tokens")]
                if not isinstance(entry["answer"], str) or min(counts) < 0:
                    raise TypeError
                self.known[str(entry["key"])] = entry
            except (ValueError, LookupError, TypeError, RecursionError):
                raise DataError(
                    f"{path}, line {number}: expected a JSON object with the keys that this command writes (key, "
                    "answer, prompt_tokens, completion_tokens, …); remove the line to ask this question again"
                ) from None
        if len(whole) < len(lines):
            write_text(path, "".join(whole))

    def add(self, key: str, question: Question, reply: Reply) -> None:
        """Append an answer to the file and flush it to the disk.

        Args:
            key: identifies the question (`key_of`).
            question: the question.
            reply: the server's answer.

        Raises:
            DataError: the file cannot be written.
        """
        entry: dict[str, str | int | None] = {
            "key": key,
            "section": question.section,
            "name": question.name,
            "option": question.option,
        }
        entry |= {"prompt": question.text, "answer": reply.text, "model": reply.model}
        entry |= {"prompt_tokens": reply.prompt_tokens, "completion_tokens": reply.completion_tokens}
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            with self.path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise DataError(f"cannot write {self.path}: {error.strerror or error}") from error
        self.known[key] = entry


def key_of(server: ChatServer, question: Question) -> str:
    """Return the sha256 of the whole request, which is everything that an answer depends on."""
    return hashlib.sha256(json.dumps(server.request(question.text), sort_keys=True).encode()).hexdigest()


def ask_all(server: ChatServer, questions: dict[str, Question], answers: Answers, config: AskConfig) -> None:
    """Ask all questions that have no answer yet, several at the same time.

    Args:
        server: the server to ask.
        questions: the questions by their keys.
        answers: the answers so far. New answers are added.
        config: the settings.

    Raises:
        InputError: the budget is spent.
    """
    todo = iter([(key, question) for key, question in questions.items() if key not in answers.known])
    progress = tqdm(total=len(questions), initial=len(questions.keys() & answers.known), unit="answer",
                    desc=config.model, dynamic_ncols=True)  # fmt: skip
    under_way: dict[Future[Reply], tuple[str, Question]] = {}
    with progress, ThreadPoolExecutor(config.parallel) as pool:
        try:
            while True:
                for key, question in _next(todo, config.parallel - len(under_way)):
                    spent = cost(list(answers.known.values()), config)
                    if config.budget is not None and spent >= config.budget:
                        raise InputError(
                            f"budget: the answers have cost {spent:.4g}, which reaches the limit of {config.budget:g}; "
                            "all answers so far are kept; repeat the command with a higher budget to continue"
                        )
                    under_way[pool.submit(server.ask, question.text)] = key, question
                if not under_way:
                    return
                for done in wait(under_way, return_when=FIRST_COMPLETED).done:
                    answers.add(*under_way.pop(done), done.result())
                    progress.update()
        finally:
            for waiting in under_way:
                waiting.cancel()


def _next(todo: Iterator[tuple[str, Question]], most: int) -> Iterator[tuple[str, Question]]:
    for _ in range(most):
        try:
            yield next(todo)
        except StopIteration:
            return


def cost(entries: Sequence[dict[str, Any]], config: AskConfig) -> float:
    """Return the cost of the answers, computed from their tokens and the prices in the settings."""
    input_tokens, output_tokens = (
        sum(entry[name] for entry in entries) for name in ("prompt_tokens", "completion_tokens")
    )
    return (input_tokens * config.input_price + output_tokens * config.output_price) / 1e6


def tables_of(answers: Sequence[tuple[Question, str]], classes: Sequence[str]) -> tuple[Tensor, Tensor, int]:
    r"""Turn answers into a table of co-occurrence and a table of heights.

    .. math:: v_{tj} = \tfrac12 (\bar a_{tj} + \bar a_{jt}), \qquad h_{ty} = \ln(\bar a_{ty} + 0.1)

    where :math:`\bar a \in [0, 1]` is the mean of all readable answers about a pair of classes, or about a class and
    a height. Entries without any readable answer are NaN.

    Args:
        answers: questions with their answers.
        classes: names of the K classes.

    Returns:
        The table of co-occurrence `(K, K)`, the table of heights `(K, 3)`, and the number of unreadable answers.
    """
    readings: dict[tuple[str, str, str], list[float]] = defaultdict(list)
    unread = 0
    for question, answer in answers:
        values = answer_values(question, answer, classes)
        unread += values is None
        for option, value in (values or {}).items():
            readings[question.section, question.name, option].append(value)
            if question.section == "beside" and question.option is not None:
                readings[question.section, option, question.name].append(value)
    names = [canonical_name(name) for name in classes]

    def mean(section: str, options: Sequence[str]) -> Tensor:
        found = [[readings.get((section, name, option), []) for option in options] for name in names]
        return torch.tensor([[sum(each) / len(each) if each else torch.nan for each in row] for row in found])

    beside, heights = mean("beside", names), mean("height", HEIGHTS)
    both = torch.stack([beside, beside.mT]).nanmean(0)
    return both.fill_diagonal_(torch.nan), (heights + 0.1).log(), unread


def read_classes(path: Path) -> tuple[str, ...]:
    """Read the names of classes from a text file with one name on each line.

    Args:
        path: the file.

    Returns:
        The names, in the order of the file.

    Raises:
        DataError: the file cannot be read.
        InputError: the file has fewer than two names, or a name occurs twice.
    """
    check_regular(path)
    try:
        names = tuple(line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    check(len(names) >= 2, "classes", "a file with at least two names", f"{path} with {len(names)}")
    class_indices(names)
    return names


def report(entries: Sequence[dict[str, Any]], unread: int, beside: Tensor, config: AskConfig, prompts: str) -> str:
    """Report the number of answers, their cost and the coverage of the table as Markdown."""
    input_tokens, output_tokens = (
        sum(entry[name] for entry in entries) for name in ("prompt_tokens", "completion_tokens")
    )
    models = ", ".join(sorted({str(entry["model"]) for entry in entries}))
    named = int((beside > 0).sum()) // 2
    rows = [
        ["", ""],
        ["model", models],
        ["sha256 of the prompts", prompts],
        ["answers", str(len(entries))],
        ["unreadable answers", str(unread)],
        ["input tokens (questions)", str(input_tokens)],
        ["output tokens (answers)", str(output_tokens)],
        ["cost", f"{cost(entries, config):.4g}" if config.input_price or config.output_price else "no prices given"],
        ["pairs of classes with a value above 0", f"{named} of {len(beside) * (len(beside) - 1) // 2}"],
    ]
    how = f"python -m train.fit_context … --table {config.out / 'beside.csv'} --source {models!r}"
    return "\n".join([*table(rows), "", f"To evaluate the tables and to fit their weights: {how}", ""])
