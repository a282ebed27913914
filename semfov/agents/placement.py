"""Where the parts of an agent compute: the eye anywhere, beliefs that hold the geometry of a scene on the CPU."""

import copy
from typing import TypeVar

from torch import nn

_Module = TypeVar("_Module", bound=nn.Module)


def on_cpu(module: _Module) -> _Module:
    """A module on the CPU, without moving the given one, which other parts of the agent may share.

    Args:
        module: the module.

    Returns:
        The module itself if all of it is on the CPU, else a copy.

    >>> layer = nn.Linear(2, 1)
    >>> on_cpu(layer) is layer
    True
    """
    if all(each.device.type == "cpu" for each in (*module.parameters(), *module.buffers())):
        return module
    return copy.deepcopy(module).cpu()
