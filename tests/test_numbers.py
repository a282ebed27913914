"""Numbers in sentences are those of the tables and of the code: `docs/numbers.toml` says of which, for each of them."""

import re

import pytest

from docs import numbers
from docs.numbers import (
    OTHERS,
    PAGES,
    Phrase,
    cells_of,
    filled,
    not_listed,
    phrases,
    text_of,
    value_of,
    without_commands,
)

PAGE = """# Fruit

| fruit | share | score |
|---|---|---|
| apple | 0.25 | 1.5 ± 0.2 |
| | 0.75 | -2.5 ± 0.3 |

<!-- table others -->
| fruit | share |
|---|---|
| apple | 0.5 |
"""


@pytest.fixture
def page(monkeypatch):
    """A page with two tables."""
    cells_of.cache_clear()
    monkeypatch.setattr(numbers, "text_of", lambda name: PAGE)
    yield "fruit.md"
    cells_of.cache_clear()


@pytest.mark.parametrize("page", phrases())
def test_numbers_are_those_of_their_tables(page):
    assert filled(text_of(page), page, phrases()[page]) == text_of(page), "python -m docs.numbers fills them"


@pytest.mark.parametrize("page", PAGES + OTHERS)
def test_measured_numbers_are_listed(page):
    text = text_of(page) if page in PAGES else without_commands(text_of(page))
    lost = not_listed(text, phrases().get(page, []))
    assert not lost, f"docs/numbers.toml says nothing of these numbers of {page}"


@pytest.mark.parametrize("page", phrases())
def test_a_number_that_is_changed_is_filled_again(page):
    text = text_of(page)
    changed = text
    for phrase in phrases()[page]:
        if not isinstance(phrase.origin, str):
            other = phrase.pattern.search(changed)
            digits = [number for group in range(1, len(phrase.origin) + 1) for number in range(*other.span(group))]
            for place in digits:
                if changed[place].isdigit():
                    changed = changed[:place] + str((int(changed[place]) + 1) % 10) + changed[place + 1 :]
    assert (changed != text) == any(not isinstance(phrase.origin, str) for phrase in phrases()[page])
    assert filled(changed, page, phrases()[page]) == text


@pytest.mark.parametrize(
    ("origin", "value"),
    [
        ("others | apple | share", 0.5),
        ("Fruit | apple / 0.75 | score", -2.5),
        ("Fruit | apple / 0.75 | score (2)", 0.3),
        ("fruit.md: Fruit | apple / 0.25 | score", 1.5),
        ("others | apple | share minus Fruit | apple / 0.75 | share", -0.25),
    ],
)
def test_a_cell_is_found_by_its_table_row_and_column(page, origin, value):
    assert value_of(origin, page) == value


@pytest.mark.parametrize("origin", ["Fruit | apple | share", "Fruit | pear | share", "Fruit | apple / 0.75 | weight"])
def test_a_name_of_no_cell_or_of_several_is_refused(page, origin):
    with pytest.raises(LookupError, match=f"{re.escape(origin)}: expected one cell"):
        value_of(origin, page)


def test_digits_and_signs_are_those_that_stand_there(page):
    listed = [
        Phrase("{} of all, {%} %", ["others | apple | share"] * 2),
        Phrase("a score {} below", ["Fruit | apple / 0.75 | score"]),
        Phrase("by {} ±", ["Fruit | apple / 0.75 | score"]),
    ]
    before = "0.1 of\nall, 7.00 %; a score 1 below; by +1.00 ±"
    assert filled(before, page, listed) == "0.5 of\nall, 50.00 %; a score 2 below; by -2.50 ±"
    with pytest.raises(LookupError, match="this phrase is not there"):
        filled("nothing", page, listed)


def test_numbers_of_sentences_are_told_from_those_of_code_and_tables():
    text = "# 1.5\n\nIt is 2.5 or `3.5` in 40 % of 50, see [4.5](x/6.5).\n\n| 7.5 |\n|---|\n| 8.5 |\n\n    9.5\n"
    lost = not_listed(text, [Phrase("see [4.5]", "a link")])
    assert len(lost) == 2
    assert all(number in " ".join(lost) for number in ("2.5", "40 %"))
