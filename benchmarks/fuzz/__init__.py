"""Fuzz semfov with thousands of bad inputs: `python -m benchmarks.fuzz --cases 1000`.

A target draws an input (`hypothesis`) for one function of semfov, and says what is right for it (`runner.Case`). Two
outcomes are allowed: the documented result, checked against something independent of the code (*right*), or one of
semfov's own errors in one line that names the argument or file (*refused by name*). A stored file that can be computed
again may also count as missing, which is right, too. Anything else is a finding.
The target `resources` also watches what a picture makes the process do: memory, time, files, sockets and processes.
"""

from benchmarks.fuzz.agents import agent_arguments, detectors, settings_values
from benchmarks.fuzz.annotations import annotation_files
from benchmarks.fuzz.borders import dtypes, frames, labels, tables, tiff_tags
from benchmarks.fuzz.images import image_files
from benchmarks.fuzz.models import darknet_files, model_fields, model_files
from benchmarks.fuzz.onnx_models import onnx_files
from benchmarks.fuzz.onnx_outputs import onnx_outputs
from benchmarks.fuzz.resources import resources
from benchmarks.fuzz.stores import look_files, part_files
from benchmarks.fuzz.tensors import boxes_on_grids, fixations, fusion_rules, observations, saliency_maps

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
        onnx_outputs,
        part_files,
        look_files,
        agent_arguments,
        settings_values,
        tiff_tags,
        dtypes,
        labels,
        tables,
        frames,
        resources,
    )
}
