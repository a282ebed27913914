"""Windows of the frames of a stream: one window of every frame, and looks that are forgotten between frames."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from semfov.agents.limits import on_cpu
from semfov.agents.windows import NEW_OBJECTS, ZoomAgent, least_of, window_objects
from semfov.data.inputs import Color, ImageLike
from semfov.data.large import LargePicture, open_large
from semfov.decision import Decision
from semfov.detection.detections import Detections
from semfov.live.base import FramePerception
from semfov.paths import WindowMoment, reduced_copy
from semfov.zoom.closer import candidates, closer_window, look_closely
from semfov.zoom.decision import CLOSER, WindowDecisions, decide_by_score
from semfov.zoom.episode import WindowStep, find_everything, look_by_look, look_for
from semfov.zoom.glances import Glance, LiveGlances, Window
from semfov.zoom.objects import without_replaced
from semfov.zoom.slices import ranked, usual_slices

WINDOW_RATE = 0.03
"""Default rate at which looks at windows are forgotten, per frame: a look counts for 23 frames."""


@dataclass(frozen=True)
class _Look:
    """A look at a window of a frame."""

    frame: int
    glance: Glance
    value: float
    closely: bool = False


class WindowPerception(FramePerception):
    r"""Looks at one window of each frame of a stream, chosen as in a search or exploration of a large picture.

    A look counts for :math:`\ln 2 / r` frames, with the rate r, or until the next look at the same window; its window
    is then worth a look again (`semfov.zoom.episode.look_by_look`). The whole frame is looked at as often. Objects are
    merged from the looks that count, and what a later look has shown as closely replaces what earlier ones did. With
    rate 0 nothing is forgotten or replaced: frames of a still picture give the looks, the closer looks and the objects
    of a search or an exploration of the picture up to its end.

    In a search a closer look takes a frame of its own, and what it has told fades (`semfov.decision.Verifier`).

    Args:
        agent: the part of an agent that looks at windows.
        target: class 1..K to search for; None finds all objects.
        targets: classes 1..K whose objects are all to be found; none: of all classes.
        rate: r, per frame, 0 or more.
        confirm: least probability for `found`, as for `ZoomAgent.search`.
        give_up: probability that a look shows the target, below which no look is worth a frame.
        closer: largest number of closer looks in :math:`\ln 2 / r` frames.
        color: order of the channels of frames that are arrays or tensors, `rgb`, or `bgr` as OpenCV reads them.

    Example::

        live = WindowPerception(agent.zoom)
        for frame in frames:
            print(live.step(frame).objects.boxes)
    """

    def __init__(
        self,
        agent: ZoomAgent,
        target: int | None = None,
        targets: tuple[int, ...] = (),
        *,
        rate: float = WINDOW_RATE,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = CLOSER,
        color: Color = "rgb",
    ) -> None:
        super().__init__(agent.classes, target, targets, rate, color)
        self.eye, self.evidence = agent.eye, None if agent.evidence is None else on_cpu(agent.evidence)
        self._thresholds = confirm, give_up
        self._decisions: WindowDecisions | None = None
        if self.evidence is not None and target is not None:
            settings: dict[str, Any] = {"confirm": confirm, "give_up": give_up, "closer": closer}
            self._decisions = WindowDecisions(
                self.evidence, target, self._close_up, forgetting=self.forgetting, **settings
            )
        self._glances: LiveGlances | None = None
        self._turns: Iterator[WindowStep[Any]] = iter(())
        self._last: WindowStep[Any] | None = None
        self._looks: list[_Look] = []
        self._number = 0

    def step(self, frame: ImageLike) -> WindowMoment:
        """Look at the next frame; see `FramePerception.step`."""
        with torch.inference_mode():
            view = self.eye.open(open_large(frame, color=self.color))
            self.check_size(view.picture.size)
            if self._glances is None:
                self._glances = LiveGlances(self.eye, view)
                self._turns = self._begin(self._glances)
            self._glances.show(view, self._number)
            if self._decisions is not None:
                self._decisions.wait()
            if self._decisions is not None and self._decisions.candidate is not None:
                value = self._decisions.candidate.probability
                self._decisions.look()
                self._looks[-1] = replace(self._looks[-1], value=value)
            else:
                self._look()
            moment = self._moment(self._glances, view.picture)
            self._number += 1
            return moment

    def _begin(self, glances: LiveGlances) -> Iterator[WindowStep[Any]]:
        """Start the episode, which never ends."""
        targets = (self.target,) if self.target is not None else self.targets
        if self.evidence is None or (glances.lattice.levels == 1 and not self.searches):
            return look_by_look(
                glances, ranked(usual_slices(glances.lattice), targets), None, forgetting=self.forgetting
            )
        if self.searches:
            assert self.target is not None
            return look_for(glances, self.evidence, self.target, confirm=math.inf, forgetting=self.forgetting)
        return find_everything(glances, self.evidence, self.target, worth=NEW_OBJECTS, forgetting=self.forgetting)

    def _look(self) -> None:
        """Spend the frame on the next look of the episode."""
        turn = self._last = next(self._turns)
        self._looks.append(_Look(self._number, turn.glance, turn.worth))
        counting, oldest = {id(look) for look in turn.looks}, self._number - self.forgetting.span
        self._looks = [
            look for look in self._looks if (look.frame >= oldest if look.closely else id(look.glance) in counting)
        ]
        if self._decisions is not None:
            self._decisions.see(turn, self._number + 1, last=turn.ahead == 0)

    def _close_up(self, box: Tensor) -> Detections:
        """Spend the frame on a closer look at a box."""
        assert self._glances is not None
        glance = look_closely(self._glances, box)
        self._looks.append(_Look(self._number, glance, 0.0, closely=True))
        return candidates(glance)

    def _moment(self, glances: LiveGlances, picture: LargePicture) -> WindowMoment:
        history = [look.glance for look in self._looks]
        places = {look.frame: place for place, look in enumerate(self._looks)}
        closer = () if self._decisions is None else self._decisions.looks
        current = without_replaced(history, glances.lattice) if self.forgetting.rate else history
        certainty = None if self.evidence is None else self.evidence.certainty_in(glances.lattice)
        objects, unseen = window_objects(
            current,
            glances.lattice,
            self.targets or self.target,
            certainty,
            None if self._last is None or self.searches else self._last.belief,
            sum(look.value for look in self._looks[1:] if not look.closely and math.isfinite(look.value)),
            latest=self.forgetting.rate > 0,
        )
        return WindowMoment(
            lattice=glances.lattice,
            classes=self.classes,
            target=self.target,
            targets=self.targets,
            decision=self._decision(history),
            number=self._number,
            glances=tuple(history),
            values=tuple(look.value for look in self._looks),
            candidates=objects,
            unseen=unseen,
            least=least_of(certainty),
            closer=tuple(replace(look, number=places[look.number]) for look in closer if look.number in places),
            next_window=self._next(glances),
            photograph=reduced_copy(picture),
        )

    def _next(self, glances: LiveGlances) -> Window:
        """The window to look at in the next frame."""
        assert self._last is not None
        candidate = None if self._decisions is None else self._decisions.candidate
        return self._last.choices[0][0] if candidate is None else closer_window(glances.lattice, candidate.box)

    def _decision(self, history: list[Glance]) -> Decision | None:
        """The decision of a search at the frame."""
        if self._decisions is not None:
            return self._decisions.decision()
        if not self.searches or self.target is None:
            return None
        return decide_by_score(history, self.target, self._thresholds[0])
