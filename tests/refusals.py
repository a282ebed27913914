"""Refusals, a line each: the words that the error must have, and the call with its arguments."""

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from semfov.errors import DataError, InputError


def _raises(error: type[Exception], words: str, call: Callable[..., object], /, *given: Any, **options: Any) -> None:
    """Check that a call raises this error, and that a part of its message matches."""
    __tracebackhide__ = True
    with pytest.raises(error, match=words):
        call(*given, **options)


refused = partial(_raises, InputError)
"""Of arguments."""
unusable = partial(_raises, DataError)
"""Of files and what is in them."""
