"""The code that docs/method.md names for each equation exists."""

import importlib
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "method.md"
ROWS = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| ") and "`" in line]
SYMBOLS = sorted({name for row in ROWS for name in re.findall(r"`((?:semfov|eval|train)[\w.]*)", row.split("|")[-2])})


def test_the_page_has_equations():
    assert len(ROWS) > 50
    assert len(SYMBOLS) > 40


@pytest.mark.parametrize("symbol", SYMBOLS)
def test_symbol_of_the_page_exists(symbol):
    parts = symbol.split(".")
    for length in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:length]))
        except ModuleNotFoundError:
            continue
        for name in parts[length:]:
            found = getattr(found, name)
        return
    pytest.fail(f"{symbol} does not exist")
