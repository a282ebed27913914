"""Questions about classes for a language model, made from a file of prompts, and the meaning of its answers."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from string import Formatter

from semfov.data.classes import canonical_name
from semfov.data.naming import named_in
from semfov.errors import DataError
from semfov.io.files import check_regular

SHIPPED = Path(__file__).parent / "context_prompts.txt"
HEIGHTS = ("top", "middle", "bottom")
OPTIONS = {"beside": "other", "height": "height"}
"""The second placeholder that prompts of each section may contain, besides `{name}`."""


@dataclass(frozen=True)
class Question:
    """A question about a class.

    Attributes:
        section: `beside` or `height`.
        name: name of the class.
        option: the other class or the height that the question asks about; None if the answer should name them.
        text: the prompt.
    """

    section: str
    name: str
    option: str | None
    text: str


def read_prompts(path: str | PathLike[str]) -> dict[str, list[str]]:
    """Read prompts from a file.

    Each paragraph below a heading such as `[beside]` is a prompt. Lines that begin with # are comments.

    Args:
        path: the file.

    Returns:
        The prompts of each section.

    Raises:
        DataError: the file cannot be read, has no prompt in the section `[beside]`, or has a prompt with an unknown
            placeholder.
    """
    check_regular(path)
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read: {error}") from error
    sections: dict[str, list[str]] = {section: [] for section in OPTIONS}
    section = None
    kept = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    for paragraph in re.split(r"\n\s*\n", re.sub(r"(?m)^(\[.*\])\s*$", r"\n\1\n", kept)):
        prompt = paragraph.strip()
        heading = re.fullmatch(r"\[(.*)\]", prompt)
        if heading:
            section = heading[1].strip()
            if section not in OPTIONS:
                raise DataError(f"{path}: expected a section [beside] or [height], got [{section}]")
        elif prompt and section is None:
            raise DataError(f"{path}: expected a section [beside] or [height] before {prompt[:40]!r}")
        elif prompt and section is not None:
            _check_prompt(prompt, section, str(path))
            sections[section].append(prompt)
    if not sections["beside"]:
        raise DataError(f"{path}: expected a prompt in the section [beside], got none")
    return sections


def _check_prompt(prompt: str, section: str, path: str) -> None:
    known = {"name", OPTIONS[section]}
    try:
        fields = {field for _, field, _, _ in Formatter().parse(prompt) if field is not None}
    except ValueError as error:
        raise DataError(
            f"{path}: {prompt[:40]!r}: {error}; write {{{{ and }}}} for braces that belong to the text"
        ) from None
    if "name" not in fields or fields - known:
        raise DataError(
            f"{path}: expected the placeholder {{name}}, optionally {{{OPTIONS[section]}}}, and no others in "
            f"{prompt[:60]!r}"
        )


def questions_of(prompts: dict[str, list[str]], classes: Sequence[str]) -> list[Question]:
    """Make the questions for all classes.

    A pair of classes is asked about in one order only, because nearness is symmetric.

    Args:
        prompts: the prompts of each section (`read_prompts`).
        classes: names of the classes.

    Returns:
        The questions.
    """
    names = [canonical_name(name) for name in classes]
    asked = []
    for section, texts in prompts.items():
        for text in texts:
            for place, name in enumerate(names):
                options: Sequence[str | None] = [None]
                if f"{{{OPTIONS[section]}}}" in text:
                    options = names[place + 1 :] if section == "beside" else HEIGHTS
                for option in options:
                    filled = text.format(name=name, **{OPTIONS[section]: option})
                    asked.append(Question(section, name, option, filled))
    return asked


def answer_values(question: Question, answer: str, classes: Sequence[str]) -> dict[str, float] | None:
    """Read the values of a question's options from the answer.

    Args:
        question: the question.
        answer: the answer.
        classes: names of the classes.

    Returns:
        A value in [0, 1] for each option, or None if the answer cannot be read.

    >>> answer_values(Question("beside", "fork", "knife", "…"), "Very often: 8.", ["knife"])
    {'knife': 0.8}
    >>> answer_values(Question("beside", "fork", None, "…"), "Knives, mugs and a table.", ["knife", "cup", "cow"])
    {'knife': 1.0, 'cup': 1.0, 'cow': 0.0}
    """
    if question.option is not None:
        value = _graded(answer)
        return None if value is None else {question.option: value}
    if question.section == "height":
        mentioned = {height: float(bool(re.search(rf"\b{height}\b", answer.lower()))) for height in HEIGHTS}
        return mentioned if any(mentioned.values()) else None
    named = named_in(answer, classes)
    return {canonical_name(name): float(name in named) for name in classes} if answer.strip() else None


def _graded(answer: str) -> float | None:
    """Read the first grade in an answer: a number from 0 to 10, yes or no."""
    for word in re.findall(r"\d+(?:\.\d+)?|[a-z]+", answer.lower()):
        if word in ("yes", "no"):
            return float(word == "yes")
        if word[0].isdigit():
            return float(word) / 10 if float(word) <= 10 else None
    return None
