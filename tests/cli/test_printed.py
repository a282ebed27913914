"""What the commands print of pictures, as a whole (`tests/golden`)."""

import re

import pytest
from PIL import Image

from semfov.observation.thresholds import Thresholds
from tests.golden import check_golden, written

COMMANDS = {
    "search": [
        ["search", "PHOTO", "--target", "red", "--start", "7,5", "--looks"],
        ["search", "EMPTY", "--target", "red", "--start", "7,5", "--shifts", "4"],
        ["search", "FOLDER", "--target", "red", "--start", "7,5", "--shifts", "4"],
    ],
    "search_in_windows": [
        ["search", "LARGE", "--target", "red", "--passes", "5", "--looks"],
        ["search", "LARGE", "--target", "red", "--confirm", "1", "--stop-below", "0", "--passes", "3", "--closer", "0"],
    ],
    "find": [
        ["find", "PHOTO", "--target", "Red, wine glass"],
        ["find", "PHOTO", "--passes", "1"],
        ["find", "LARGE", "--target", "red", "--passes", "2", "--looks"],
        ["find", "FOLDER", "--passes", "1"],
    ],
    "explore": [
        ["explore", "PHOTO", "--how", "fovea", "--start", "7,5", "--shifts", "2", "--looks"],
        ["explore", "LARGE", "--min-gain", "1000"],
    ],
}


@pytest.fixture
def pictures(photo, large, tmp_path):
    """Files by their names in commands: a photograph, one without objects, a folder with a damaged one, a large one."""
    empty = tmp_path / "empty.png"
    Image.new("RGB", (160, 120), (100, 100, 100)).save(empty)
    folder = tmp_path / "photos"
    folder.mkdir()
    for name, file in (("a.png", photo), ("b.png", empty)):
        (folder / name).write_bytes(file.read_bytes())
    (folder / "c.png").write_bytes(photo.read_bytes()[:120])
    return {"PHOTO": photo, "EMPTY": empty, "FOLDER": folder, "LARGE": large}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_is_printed_of_pictures(name, run, agent, evidence, pictures, accept):
    if "LARGE" in {word for command in COMMANDS[name] for word in command}:
        evidence.places = Thresholds(0.4, 0.0, 0.0)
        agent.windows = evidence
    parts = []
    for command in COMMANDS[name]:
        code, printed = run(*(pictures.get(word, word) for word in command))
        # Without bars of progress, and without what Pillow says in brackets.
        lines = [line.strip().partition(" (")[0] for line in re.split("[\r\n]", printed.err) if "%|" not in line]
        errors = "".join(f"{line}\n" for line in lines if line)
        parts.append(f"$ semfov {' '.join(command)}\n{printed.out}{errors}exit code {code}\n")
    names = {path: name for name, path in pictures.items()}
    check_golden(name, written("\n".join(parts), names), accept=accept)
