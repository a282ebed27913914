"""Decisions after each look, for all kinds of look (see the table in `semfov.decision`)."""

from semfov.decision.candidates import CandidatePlace
from semfov.decision.rule import GO_ON, CloseUp, Decision


class DecisionState:
    """Base of decisions that follow the looks of an episode; the base itself decides nothing.

    Attributes:
        criterion: what the decision `found` needs, in words; None where nothing is decided.
        outcome: outcome of the last look, a number of `OUTCOMES`; `GO_ON` before the first one.
    """

    criterion: str | None = None
    outcome: int = GO_ON

    @property
    def decision(self) -> Decision | None:
        """The decision as it stands; None where nothing is decided, and before the first look."""
        return None

    @property
    def candidate(self) -> CandidatePlace | None:
        """The place that is to be looked at closely now; None if there is none."""
        return None

    @property
    def looks(self) -> list[CloseUp]:
        """The closer looks so far."""
        return []
