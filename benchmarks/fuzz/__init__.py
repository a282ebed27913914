"""Fuzz semfov with thousands of bad inputs: `python -m benchmarks.fuzz --cases 1000`.

A target is a function that draws an input (`hypothesis`), passes it to semfov, and checks the outcome. Two outcomes are
allowed: the documented result, checked against something independent of the code (*right*), or one of semfov's own
errors in one line that names the argument or file (*refused by name*). A stored file that can be computed again may
also count as missing, which is right, too. Anything else is a finding.
"""

from benchmarks.fuzz.annotations import annotation_files
from benchmarks.fuzz.arguments import agent_arguments, settings_values
from benchmarks.fuzz.detectors import detectors
from benchmarks.fuzz.fields import model_fields
from benchmarks.fuzz.fusion import fusion_rules
from benchmarks.fuzz.gaze import fixations
from benchmarks.fuzz.grids import boxes_on_grids
from benchmarks.fuzz.images import image_files
from benchmarks.fuzz.models import darknet_files, model_files
from benchmarks.fuzz.observations import observations
from benchmarks.fuzz.onnx_models import onnx_files
from benchmarks.fuzz.saliency import saliency_maps
from benchmarks.fuzz.stores import look_files, part_files

TARGETS = {
    target.__name__: target
    for target in (
        image_files,
        annotation_files,
        detectors,
        fixations,
        boxes_on_grids,
        fusion_rules,
        observations,
        saliency_maps,
        model_files,
        darknet_files,
        model_fields,
        onnx_files,
        part_files,
        look_files,
        agent_arguments,
        settings_values,
    )
}
