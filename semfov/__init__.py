"""semfov looks at pictures as eyes do: piece by piece, where it pays.

One agent takes a photograph, a picture of any size, a panorama or a camera, and chooses how to look at it::

    agent = semfov.ActivePerception.recommended()
    agent.search("kitchen.jpg", "cup").decision  # is there a cup, and where?
    agent.find_all("harbour.jpg", "person", passes=16).objects  # all people of a large picture
    agent.explore("kitchen.jpg").plot()  # what is where
    agent.search(semfov.Panorama("street.jpg"), "bicycle")  # turns its head
    agent.live("cup").step(frame)  # a look at each frame of a camera

Its records print, draw, save and convert themselves. The command `semfov` does the same from a shell, and `semfov fit`
fits the agent to a detector of your own. Each part is also a function or a differentiable module: `semfov.foveate`,
`semfov.fusion`, `semfov.acquisition`, `semfov.rollout`.
"""

import lazy_loader

import semfov.cli.start  # noqa: F401 (before what takes long to import)
from semfov.attribute_words import PACKAGE, missing

# Names are imported when they are first asked for (the stub says from where): the help of the command needs none.
_named, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """Import a public name when it is first asked for; suggest ours where others have another word for it."""
    try:
        return _named(name)
    except AttributeError:
        raise missing("semfov", name, PACKAGE, __all__) from None
