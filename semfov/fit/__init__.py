"""Fits, for a detector, everything that the agent needs, to looks that are made once and stored.

    photographs ─► looks from cells ─┬─► labelled detections ─► what scores mean
                   (`looking`)       │   (`samples`)            (`observation`, `cells`)
                                     ├─► beliefs of searches ─► odds of a miss, presence, thresholds
                                     │   (`search`)             (`through_belief`, `presence`, `thresholds`)
                                     └─► closer looks ────────► `verification`
                                         (`searches`)
    mosaics ─────► looks at windows ─┬─► pairs of looks ──────► numbers of objects (`windows_evidence`)
                   (`zoom_store`)    ├─► searches ────────────► presence, closer looks (`windows_decisions`)
                                     └─► explorations ────────► which objects are there (`windows_certainty`)
    photographs ─► looks at slices ────► searches ────────────► `photographs`
    pictures that people viewed ─► feature maps (`viewing`) ──► where people look (`gaze`, `gaze_adapted`)

`MosaicFit.fit` (`windows`) fits all that is of windows. `folder` fits the parts of a folder of models one after another
and keeps those that are better than raw scores; a finished part is read again (`part`). Reports say what was measured.
Looks are stored by `semfov.runs.looking`, `semfov.runs.zoom_store` and `semfov.human.viewing`.
"""
