"""Episodes over the windows of a picture: for one object of a class, or for all objects."""

from collections.abc import Iterator, Sequence

from semfov.episode import Forgetting
from semfov.zoom.belief import Rates, ZoomBelief
from semfov.zoom.episode import WindowStep, look_by_look
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance, Glances, Window
from semfov.zoom.policy import WindowChoice, best_find, best_hit, best_slice, jointly


def look_for(
    glances: Glances,
    evidence: GlimpseEvidence,
    target: int,
    *,
    confirm: float = 0.3,
    slices: Sequence[Window] | None = None,
    closest: bool = False,
    forgetting: Forgetting | None = None,
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for one object of a class, look by look, until a look confirms it or nothing is left to look at.

    Args:
        glances: source of looks at the picture.
        evidence: learned evidence by magnification.
        target: class 1..K.
        confirm: score from which on a look confirms the target.
        slices: windows that can confirm the target; None lets windows of all magnifications confirm it.
        closest: whether only windows of the last level can confirm it.
        forgetting: forgetting between the frames of a stream, which never end (`look_by_look`).

    Yields:
        Each turn.
    """
    belief, last = ZoomBelief(glances.lattice, evidence, target), glances.lattice.levels - 1
    allowed = None if slices is None else set(slices)

    def best(looks: Sequence[Glance], done: set[Window]) -> Sequence[WindowChoice]:
        choice = best_hit(belief, done, closest=closest) if slices is None else best_slice(belief, slices, done)
        return [] if choice is None else [choice]

    def ends(glance: Glance) -> bool:
        window = glance.window
        confirms = window in allowed if allowed is not None else window.level == last or not closest
        return confirms and float(glance.show[target - 1]) >= confirm

    yield from look_by_look(glances, best, belief, ends=ends, forgetting=forgetting)


def find_everything(
    glances: Glances,
    evidence: Rates,
    target: int | None = None,
    *,
    batch: int = 1,
    worth: float = 0.0,
    forgetting: Forgetting | None = None,
) -> Iterator[WindowStep[ZoomBelief]]:
    """Look for all objects of a class, or of all classes, look by look, until no look promises enough.

    Args:
        glances: source of looks at the picture.
        evidence: learned evidence by magnification.
        target: class 1..K; None for all classes.
        batch: number of windows that are chosen jointly and looked at together.
        worth: the exploration ends when no look is expected to find more new objects than this.
        forgetting: forgetting between the frames of a stream, which never end (`look_by_look`).

    Yields:
        Each turn; the value of a look is the number of new objects that it is expected to find.
    """
    belief = ZoomBelief(glances.lattice, evidence, target or 0)

    def best(looks: Sequence[Glance], done: set[Window]) -> Sequence[WindowChoice]:
        chosen = jointly(lambda visited: best_find(belief, visited, belief.foresight), belief, done, batch)
        return [choice for choice in chosen if choice[1] > worth]

    yield from look_by_look(glances, best, belief, hints=False, forgetting=forgetting)
