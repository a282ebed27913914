"""Command lines from dataclasses: help, YAML files, dotted overrides, exit codes."""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from jsonargparse import ArgumentParser, set_parsing_settings

from semfov.errors import SemfovError

Config = TypeVar("Config")


def make_parser(
    config: type[Any], description: str | None, positional: tuple[str, str] | None = None
) -> ArgumentParser:
    """A parser with an option for every field of `config`, nested fields dotted, and `--config FILE.yaml`.

    Args:
        config: dataclass of the settings.
        description: for `--help`.
        positional: a path among the fields that is given without its name and may be left out, and its help.
    """
    set_parsing_settings(docstring_parse_attribute_docstrings=False)
    parser = ArgumentParser(
        prog=None, description=description, default_env=False, formatter_class=_formatter(), exit_on_error=True
    )
    parser.add_argument("--config", action="config", help="YAML file with settings; options after it override it.")
    if positional is not None:
        parser.add_argument(positional[0], nargs="?", type=Path, help=positional[1])
    parser.add_class_arguments(config, as_group=True, skip=set() if positional is None else {positional[0]})
    return parser


def _formatter() -> Any:
    import argparse

    from jsonargparse import DefaultHelpFormatter

    class Formatter(DefaultHelpFormatter, argparse.RawDescriptionHelpFormatter):
        """Keeps the line breaks of the description."""

    return Formatter


def run_command(
    main: Callable[[Config], None],
    config: type[Config],
    description: str | None,
    arguments: Sequence[str] | None = None,
    *,
    positional: tuple[str, str] | None = None,
) -> int:
    """Parse `arguments` into a `config` and call `main` with it.

    Returns:
        0, or 1 after a `SemfovError` (printed in one line), or 130 after Ctrl-C; usage errors exit with 2.
    """
    parser = make_parser(config, description, positional)
    parsed = parser.parse_args(arguments)
    parsed.pop("config", None)
    settings = parser.instantiate(parsed)
    try:
        main(config(**settings.as_dict()))
    except SemfovError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; the same command goes on where this one stopped", file=sys.stderr)
        return 130
    return 0
