"""Decisions of searches: the rule, the evidence that it rests on, and closer looks at places."""

from semfov.decision.candidates import SAME, CandidateCells, CandidatePlace, CandidatePlaces
from semfov.decision.closer_look import CloserLook
from semfov.decision.evidence import cell_of, confirms, goal_cells, strength, strongest
from semfov.decision.rule import (
    NEARLY,
    OUTCOMES,
    Decision,
    Outcome,
    check_thresholds,
    conclude,
    decide,
    outcome_by_gain,
    outcome_of,
    place_known,
    settle,
    surely,
    verified,
)
from semfov.decision.verifier import MOST, Verifier

__all__ = [
    "MOST",
    "NEARLY",
    "OUTCOMES",
    "SAME",
    "CandidateCells",
    "CandidatePlace",
    "CandidatePlaces",
    "CloserLook",
    "Decision",
    "Outcome",
    "Verifier",
    "cell_of",
    "check_thresholds",
    "conclude",
    "confirms",
    "decide",
    "goal_cells",
    "outcome_by_gain",
    "outcome_of",
    "place_known",
    "settle",
    "strength",
    "strongest",
    "surely",
    "verified",
]
