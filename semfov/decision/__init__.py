"""Decisions of searches: is the target there, and where; when a search ends, and how.

The numbers of a search, with one name each everywhere:

    word         what it is                    where it is defined          with fitted models, and without
    -----------  ----------------------------  ---------------------------  ----------------------------------------
    score        the number of a detection     `Detections.scores`          the detector's in both; without models
                 for a class                                                it decides
    presence     probability that the picture  `Belief.presence`, after     with: calibrated; without: a fovea has
                 holds the target              closer looks                 that of its most probable cell by raw
                                               `PlaceVerifier.presence`;    scores, windows have none; a head has
                                               by windows `SearchFacts`     that of its most probable cell in both
    place        probability that the target   `CloseUp.place`              with: a fovea by the verification,
                 is at one place, after a                                   windows by the certainty of the object
                 closer look at it                                          there, in a photograph fitted to places;
                                                                            without: no closer looks
    hit_chance   chance that the best          `Belief.chance`; by windows  with: calibrated; without: it is not
                 remaining look shows the      `WindowStep.next_value`      asked for
                 target, if no look so far has
    probability  of a cell: that the target    `Belief.probability`         with: calibrated; without: by raw scores
                 is in it
                 of a candidate: that the      `CandidatePlace`             with: before its closer look; without:
                 target is there                                            there are no candidates

A `Decision` has two of them:

    field        outcome    with closer looks          by the belief alone        without fitted models
    -----------  ---------  -------------------------  -------------------------  ------------------------------
    probability  found      presence, or the place     presence                   a fovea: presence; windows:
                            where it is larger                                    score of the detection found
                 otherwise  presence                   presence                   a fovea: presence; windows:
                                                                                  best score so far
    place        found      place of the best closer   a fovea: probability of    a fovea: probability of the
                            look                       the cell; windows: None    cell; windows: None
                 otherwise  None                       None                       None

What is compared with what, by the kind of look. With closer looks (`PlaceVerifier`) places decide, without them
presence does (`settle`):

    what                         fovea                                   windows
    ---------------------------  --------------------------------------  -----------------------------------------------
    hit_chance < stop_below: no  of the best cell that was not fixated   of the best window that was not looked at; in a
    look is worth a pass                                                 photograph of the next closer look
    >= confirm, with closer      place of a closer look                  as a fovea
    looks
    >= confirm, without          presence, if a fixated cell is nearly   presence, if a detection shows the target
                                 the most probable one
    a closer look is due         at a cell from Thresholds.place on, if  at an object that is likely, from LIKELY on; at
                                 a fixated cell is nearly the most       the last look from Thresholds.place on, in a
                                 probable one, or at the last look       photograph from stop_below on
    a closer look                tells of its place and of the picture   is one more look: place and presence are those
                                 (`Verifier`)                            of all looks that count (`ObjectVerifier`)
    a place ends the search at   if it is sure: from half-way between    as a fovea
    once                         confirm and 1 on, after MOST_CLOSER
                                 closer looks from confirm
    the search is over           hit_chance < stop_below, or all closer  as a fovea; in a photograph at most
                                 looks were made                         MOST_IN_PHOTOGRAPH
    at a limit                   closer looks that are due are made      it ends as it is
                                 with the passes that remain; it is over
    compared by, with closer     `Verifier.outcome` of `CandidateCells`  `ObjectVerifier.outcome` of `ObjectPlaces`
    looks
    compared by, without         `settle`, called by `decide`            `settle`, called by `DecisionsByPresence`
    closer looks
    `settle` is called, too,     by a head (`semfov.agents.head`), and by the fit, to choose thresholds
                                 (`semfov.fit.thresholds`)
    outcome, if over             found with a place, or presence, from confirm on; else absent if presence < 1/2, else
                                 undecided
    outcome, if not over         found on the same terms, else undecided
    ending of the record         "decision" if it is over or found; else the limit, or "cells" / "shifts" of a fovea and
                                 "windows" where none is left

Places of windows are in `semfov.zoom.places`, and decisions by windows in `semfov.zoom.decision`.

Without fitted models no probability decides: a detection whose score is at least `confirm` is `found` (ending
"detection"), with a fovea if it covers the fixated cell well enough (`detects`, `confirms`); nothing is `absent`.

A head has no closer looks that decide: the target is found if presence and the cell of the present gaze reach
`confirm`, and `stop_below` is compared with the best cell that was not fixated (`semfov.agents.head`).
"""

from semfov.decision.candidates import CandidateCells, CandidatePlace, CandidatePlaces
from semfov.decision.rule import (
    ABSENT,
    FOUND,
    GO_ON,
    MOST_CLOSER,
    OUTCOMES,
    UNDECIDED,
    CloseUp,
    Decision,
    Outcome,
    cell_of,
    check_thresholds,
    confirms,
    decide,
    decision_without_closer_looks,
    detects,
    final_outcome,
    found_at_once,
    gains_less,
    most_evident_box,
    place_known,
    settle,
)
from semfov.decision.verifier import Judgement, PlaceVerifier, Verifier

__all__ = [
    "ABSENT",
    "FOUND",
    "GO_ON",
    "MOST_CLOSER",
    "OUTCOMES",
    "UNDECIDED",
    "CandidateCells",
    "CandidatePlace",
    "CandidatePlaces",
    "CloseUp",
    "Decision",
    "Judgement",
    "Outcome",
    "PlaceVerifier",
    "Verifier",
    "cell_of",
    "check_thresholds",
    "confirms",
    "decide",
    "decision_without_closer_looks",
    "detects",
    "final_outcome",
    "found_at_once",
    "gains_less",
    "most_evident_box",
    "place_known",
    "settle",
]
