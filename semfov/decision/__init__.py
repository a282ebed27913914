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
    place        probability that the target   `CloseUp.place`              with: by the verification, in a large
                 is at one place, after a                                   picture by the certainty of the object
                 closer look at it                                          there; without: no closer looks
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

    what                     fovea                       large picture               photograph by windows
    -----------------------  --------------------------  --------------------------  ---------------------------
    hit_chance < stop_below: of the best cell that was   of the best window that     of the best place that was
    no look is worth a pass  not fixated                 was not looked at           not examined, times (1 - the
                                                                                     largest place so far)
    >= confirm, with         place of a closer look      as a fovea                  as a fovea
    closer looks
    >= confirm, without      presence, if a fixated      presence, if a detection    as a large picture
                             cell is nearly the most     shows the target
                             probable one
    a closer look is due     at a cell from              at an object that is        where the hit chance of
                             Thresholds.place on, if a   likely, from LIKELY on; at  that place >= stop_below
                             fixated cell is nearly the  the last look from
                             most probable one, or at    Thresholds.place on
                             the last look
    a closer look            tells of its place and of   is one more look: place     as a fovea, by windows
                             the picture (`Verifier`)    and presence are those of   (`Verifier`)
                                                         all looks that count
                                                         (`ObjectVerifier`)
    a place ends the search  if it is sure: from half-   as a fovea                  never: the next place may
    at once                  way between confirm and 1                               be surer
                             on, after MOST_CLOSER
                             closer looks from confirm
    the search is over       hit_chance < stop_below, or as a fovea                  as a fovea
                             all closer looks were made
    at a limit               closer looks that are due   it ends as it is            as a large picture
                             are made with the passes
                             that remain; it is over
    compared by, with        `Verifier.outcome` of       `ObjectVerifier.outcome`    `Verifier.outcome` of
    closer looks             `CandidateCells`            of `ObjectPlaces`           `PhotographPlaces`
    compared by, without     `decide`                    `settle`, called by         as a large picture
    closer looks                                         `DecisionsByPresence`
    outcome, if over         found with a place, or presence, from confirm on; else absent if presence < 1/2, else
                             undecided
    outcome, if not over     found on the same terms, else undecided
    ending of the record     "decision" if it is over or found; else the limit, or "cells" / "shifts" of a fovea and
                             "windows" where none is left

Places of large pictures are in `semfov.zoom.places`, those of photographs in `semfov.zoom.closer`, and decisions by
windows in `semfov.zoom.decision`.

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
