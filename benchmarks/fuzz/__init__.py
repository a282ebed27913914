"""Bad input by the thousand: `python -m benchmarks.fuzz --cases 1000`.

A target is a function that draws an input (`hypothesis`), hands it to semfov, and checks what comes back: the
documented result, compared with something independent of the code (*right*), or one of semfov's own errors, in one
line that names the thing (*refused by name*); what can be made again may count as missing, which is right, too.
Anything else is a finding.
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
