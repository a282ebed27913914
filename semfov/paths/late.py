"""Attributes of records that are made when they are read for the first time."""

from typing import Any

_NONE = object()  # a field without a default


class MadeWhenRead:
    """A field that can be given as a function, which then makes it when it is read for the first time.

    The function must rest on nothing that changes, so that it makes then what it would have made at once.

    Args:
        default: default of the field; it has none without one.
    """

    def __init__(self, default: object = _NONE) -> None:
        self._default = default

    def __set_name__(self, owner: type, name: str) -> None:
        self._name = name

    def __get__(self, record: Any, owner: type | None = None) -> Any:
        if record is None:
            # So `dataclass` asks for the default.
            if self._default is _NONE:
                raise AttributeError(self._name)
            return self._default
        # The function, until it was called, and what it made stand under one name.
        values = vars(record)
        if callable(values[self._name]):
            values[self._name] = values[self._name]()
        return values[self._name]

    def __set__(self, record: Any, value: Any) -> None:
        vars(record)[self._name] = value
