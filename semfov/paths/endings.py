"""Reasons for the end of a search or an exploration, and the sentences that explain them."""

from __future__ import annotations

from typing import Literal

Ending = Literal[
    "box", "decision", "detection", "worth", "shifts", "cells", "passes", "windows", "seconds", "duration", "stopped"
]
"""Reason for the end of a search or an exploration: the gaze was on a given box, the search decided, a detection
showed the target at the gaze in a search whose belief has no thresholds, no look was worth it, all gaze shifts were
made, every cell was fixated, the passes were used up, no window was left that can show the target, the time on this
machine was over, the time of the scene was over, or the caller stopped it."""

FIXATIONS = {
    "box": "The gaze is on a box of the target.",
    "detection": "A detection shows the target at the gaze.",
    "worth": "No look is expected to classify enough more cells correctly.",
    "cells": "Every cell was fixated.",
    "duration": "The next look would end after the time limit of the scene.",
    "seconds": "The time was over.",
    "stopped": "It was stopped.",
    "found": "The target is probable enough, and was looked at closely enough.",
    "absent": "No remaining cell is worth a look, and the target is probably absent.",
    "undecided": "No remaining cell is worth a look, but the target is probably there.",
    "closer found": "A closer look confirmed the target.",
    "closer undecided": "No closer look was sure enough, but the target is probably there.",
}
"""Sentences for looks of a fovea, by the ending, or by the outcome of the decision that ended the search."""

WINDOWS = {
    "worth": "No remaining look is expected to show enough new objects.",
    "seconds": "The time was over.",
    "stopped": "It was stopped.",
    "windows": "No window is left that can show more.",
    "detection": "A detection shows the target.",
    "found": "The probability is high enough, and a detection shows the target.",
    "absent": "No remaining look is worth a pass, and the target is probably absent.",
    "undecided": "No remaining look is worth a pass, but the target is probably there.",
    "unseen": "No look shows a candidate: the probability is how frequent the class is, not something seen.",
    "first found": "The first look shows the target closely enough.",
    "closer found": "A closer look confirmed the target.",
    "closer absent": "No closer look was sure enough, and the target is probably absent.",
    "closer undecided": "No closer look was sure enough, but the target is probably there.",
}
"""Sentences for looks at windows, by the ending, or by the outcome of the decision that ended the search; `unseen` is
for a photograph in which no look shows a place that may hold the target."""
