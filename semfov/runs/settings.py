"""Settings of commands and studies: dataclasses that are checked when they are made, and written and read as YAML."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import yaml

from semfov.io.files import JsonObject
from semfov.io.ranges import CheckedSettings


@dataclass(frozen=True)
class Settings(CheckedSettings):
    """Base of dataclasses of settings that are options of a command, or are read from a file."""

    unused: ClassVar[tuple[str, ...]] = ()  # inherited settings that mean nothing here: no options, and not written

    def plain(self) -> JsonObject:
        """Write the settings as JSON values, in which paths are text and tuples are lists."""
        return plain({name: value for name, value in asdict(self).items() if name not in self.unused})

    def yaml(self) -> str:
        """Write the settings as a file that `--config` reads."""
        return yaml.safe_dump(self.plain(), sort_keys=False)


_DEEPEST = 100
"""Lists and objects within each other that a text of settings may have; loaders call themselves for each."""


def load_yaml(text: str) -> Any:
    """Read settings, without aliases, which a few lines multiply to any number of values, and not nested without end.

    Args:
        text: YAML.

    Returns:
        The value, as the parser of commands takes it.

    Raises:
        yaml.YAMLError: the text is no such YAML.
    """
    from jsonargparse import get_loader

    depth = 0
    for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
        if isinstance(event, yaml.AliasEvent):
            line = "" if event.start_mark is None else f"line {event.start_mark.line + 1}: "
            raise yaml.YAMLError(f"{line}expected values, got the alias *{event.anchor}")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise yaml.YAMLError(f"expected lists and objects at most {_DEEPEST} deep, got deeper ones")
    return get_loader("yaml")(text)


def plain(settings: Mapping[str, object]) -> JsonObject:
    """Convert settings to JSON values: paths become text, tuples become lists."""
    return json.loads(json.dumps(settings, default=str))
