"""Decisions of searches: the rule, the evidence that it rests on, and closer looks at places."""

from semfov.decision.candidates import SAME, CandidateCells, CandidatePlace, CandidatePlaces
from semfov.decision.rule import (
    OUTCOMES,
    CloseUp,
    Decision,
    Outcome,
    cell_of,
    check_thresholds,
    conclude,
    confirms,
    decide,
    detects,
    gains_less,
    place_known,
    settle,
    verified,
)
from semfov.decision.verifier import MOST_CLOSER, Verifier

__all__ = [
    "MOST_CLOSER",
    "OUTCOMES",
    "SAME",
    "CandidateCells",
    "CandidatePlace",
    "CandidatePlaces",
    "CloseUp",
    "Decision",
    "Outcome",
    "Verifier",
    "cell_of",
    "check_thresholds",
    "conclude",
    "confirms",
    "decide",
    "detects",
    "gains_less",
    "place_known",
    "settle",
    "verified",
]
