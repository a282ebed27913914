"""Measure calibration: `python -m eval.calibration` evaluates scores, an observation model and beliefs on photographs.

    python -m eval.calibration --data.root DIR --data.annotations instances.json --out runs/calibration

Without photographs it uses the embedded scenes. Every photograph is fixated at random points, and detections are
matched to the annotated boxes. For every level of distance from the fixation, a table gives how well raw and calibrated
scores predict the true class, background included. Use photographs on which the model was not fitted.

Then every photograph is searched for a class that it holds and for a class that it does not hold. Tables and a
reliability diagram show how well the belief's probabilities agree with which cells hold the target, by number of looks
and by distance from the closest fixation. The beliefs use raw scores, calibrated scores as published, tempered scores,
and learned observation models. Detections from every cell are stored and shared with `python -m eval.search`.
"""

from eval.calibration.evaluation import CalibrationConfig, judge_calibration
from semfov.runs.command import command

main = command(judge_calibration, CalibrationConfig, __doc__)
