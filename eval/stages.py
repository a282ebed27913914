"""Where the time of each look goes."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from semfov import ActivePerception

STAGES = ("foveate", "detect", "weigh", "update belief", "choose")
"""Stages of a look, in order."""


class Stages:
    """Seconds that each stage of each look takes.

    Attributes:
        looks: for each look, in order, its seconds by stage.
    """

    def __init__(self) -> None:
        self.looks: list[dict[str, float]] = []

    @contextmanager
    def watch(self, agent: ActivePerception) -> Iterator[None]:
        """Measure what `agent` does in the block, by standing between it and the methods that it calls."""
        with ExitStack() as stack:

            def stand_in(owner: Any, name: str, wrap: Callable[[Any], Any]) -> None:
                stack.enter_context(_replaced(owner, name, wrap(getattr(owner, name))))

            stand_in(agent.eye, "look", self._begin)
            stand_in(agent.eye, "foveated", self._timed("foveate"))
            stand_in(agent.eye.detector, "detect", self._timed("detect"))
            for observer in {id(o): o for o in (agent.observer, agent.semantics)}.values():
                stand_in(observer, "weigh", self._timed("weigh"))
                stand_in(observer, "update", self._timed("update belief"))
            for policy in ("policy", "exploration"):
                stand_in(agent, policy, lambda make: lambda *given: self._timed("choose")(make(*given)))
            yield

    def _begin(self, look: Callable[..., Any]) -> Callable[..., Any]:
        def begin(*given: Any) -> Any:
            self.looks.append(defaultdict(float))
            return look(*given)

        return begin

    def _timed(self, stage: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        def wrap(call: Callable[..., Any]) -> Callable[..., Any]:
            def timed(*given: Any) -> Any:
                began = time.perf_counter()
                result = call(*given)
                self.looks[-1][stage] += time.perf_counter() - began
                return result

            return timed

        return wrap


@contextmanager
def _replaced(owner: Any, name: str, stand_in: Any) -> Iterator[None]:
    """Set an attribute of an object for a while; what its class defines comes back by itself."""
    own = name in vars(owner)
    before = getattr(owner, name)
    setattr(owner, name, stand_in)
    try:
        yield
    finally:
        if own:
            setattr(owner, name, before)
        else:
            delattr(owner, name)
