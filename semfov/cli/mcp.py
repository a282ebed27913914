"""Subcommand mcp: tools for language models over the pictures below a folder, by the Model Context Protocol."""

import sys
from collections.abc import Callable
from dataclasses import asdict
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from semfov.cli.agent import make_agent
from semfov.cli.options import McpOptions
from semfov.cli.picture_tools import Answer, Gaze, PictureTools
from semfov.errors import DataError, SemfovError
from semfov.version import __version__

if TYPE_CHECKING:
    from mcp.server import MCPServer

_INSTRUCTIONS = """\
Look for objects in pictures that are too large or too full to be seen at once. `pictures` lists them by their names.
Use `search` to decide whether a thing is there and where, `find` for all objects of a class and how many to expect,
`look` to see a place closely yourself, and `where_people_look` for what draws attention. Boxes are x1, y1, x2, y2 in
pixels of the picture, from its upper left corner. Each answer says what was spent (`passes` of the detector) and what
further looks can still bring; give more `passes` if that is worth it. The detector knows a fixed list of classes."""

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def serve(options: McpOptions) -> int:
    """Serve the tools on standard input and output until the client leaves.

    Args:
        options: the options of the command.

    Returns:
        The exit code.
    """
    try:
        import mcp.server  # noqa: F401
    except ImportError:
        raise DataError('mcp: expected the SDK of the protocol; pip install "semfov[mcp]"') from None
    server = make_server(PictureTools(options.folder, make_agent(options)))
    if sys.stdin.isatty():
        print("semfov mcp waits for a program that speaks the protocol; Ctrl-C ends it", file=sys.stderr)
    server.run("stdio")
    return 0


def make_server(tools: PictureTools) -> "MCPServer[Any]":
    """Make the server whose tools look at pictures.

    Args:
        tools: what looks.

    Returns:
        The server, which is run by `run`.
    """
    from mcp.server import MCPServer
    from mcp.server.mcpserver import Image

    server = MCPServer("semfov", instructions=_INSTRUCTIONS, version=__version__, log_level="WARNING")

    @server.tool()
    @_telling
    def pictures() -> list[str]:
        """List the pictures by the names that the other tools take; at most a thousand."""
        return tools.pictures()

    known = f"Classes: {', '.join(tools.agent.classes[1:])}"
    decides = "Decide whether a thing is in a picture, and where; `prior` is how likely it is before a look."

    @server.tool(description=f"{decides} {known}")
    @_telling
    def search(picture: str, target: str, passes: int = 16, prior: float | None = None) -> Answer:
        return tools.search(picture, target, passes, prior)

    @server.tool(description=f"Find all objects of some classes, or of all ([]), and how many to expect. {known}")
    @_telling
    def find(picture: str, classes: list[str], passes: int = 24) -> Answer:
        return tools.find(picture, classes, passes)

    @server.tool(structured_output=False)
    @_telling
    def look(picture: str, x: float, y: float, width: float) -> list[Any]:
        """See a square crop of a picture, `width` pixels wide around x, y, and what the detector shows in it."""
        view = tools.look(picture, x, y, width)
        return [
            Image(data=view.jpeg, format="jpeg"),
            {"box": view.box, "objects": [asdict(one) for one in view.objects]},
        ]

    @server.tool()
    @_telling
    def where_people_look(picture: str) -> Gaze:
        """Predict the places at which people look in a picture that they view freely, with the share of fixations."""
        return tools.where_people_look(picture)

    @server.tool()
    @_telling
    def check(fixations: str) -> list[str]:
        """Say what is suspicious in a file of an eye tracker's fixations in these pictures: frame, unit, origin."""
        return tools.check(fixations)

    return server


def _telling(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Let a tool tell the model why a call is refused; of other errors the protocol tells nothing."""
    from mcp.server.mcpserver.exceptions import ToolError

    @wraps(function)
    def call(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Result:
        try:
            return function(*arguments, **options)
        except SemfovError as error:
            raise ToolError(str(error)) from error

    return call
