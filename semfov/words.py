"""What others, and other programs, call an option or an attribute; the command reads it before it loads anything."""

from collections.abc import Mapping
from typing import Any

OTHER_WORDS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("conf", "conf_thres", "confidence", "min_score", "score", "threshold"), ("least", "confirm")),
    **dict.fromkeys(("class", "class_name", "cls", "label", "labels", "name", "query", "targets"), ("target",)),
    **dict.fromkeys(("file", "image", "img", "path", "photo", "source"), ("picture",)),
    **dict.fromkeys(("cells", "columns", "rows"), ("grid",)),
    **dict.fromkeys(("model", "yolo"), ("detector",)),
    "models": ("model",),
    **dict.fromkeys(("gpu", "cuda"), ("device",)),
    **dict.fromkeys(("fp16", "float16"), ("half",)),
    **dict.fromkeys(("csv", "format", "json", "output", "project", "save"), ("out",)),
    **dict.fromkeys(("html", "page"), ("report",)),
    **dict.fromkeys(("crop", "save_crop", "save_crops"), ("crops",)),
    **dict.fromkeys(("label_dir", "save_txt", "txt", "yolo_labels"), ("labels",)),
    **dict.fromkeys(("budget", "iterations", "looks", "max_passes", "max_steps", "n", "steps"), ("passes",)),
    **dict.fromkeys(("fixations", "max_fixations", "max_shifts", "n_fixations", "saccades"), ("shifts", "passes")),
    **dict.fromkeys(("max_seconds", "time", "time_limit", "timeout"), ("seconds",)),
    **dict.fromkeys(("jobs", "num_workers", "processes", "threads"), ("workers",)),
    **dict.fromkeys(("callback", "on_step"), ("on_look",)),
    "verbose": ("looks", "quiet"),
    "silent": ("quiet",),
    "batch_size": ("batch",),
    "classes": ("target",),
    "names": ("classes",),
    **dict.fromkeys(("agnostic", "agnostic_nms", "nms_per_class", "class_agnostic"), ("per_class",)),
    **dict.fromkeys(("bgr", "channels", "color", "colours", "colors"), ("colour",)),
}

OF_OTHER_METHODS = {
    ("explore", "target"): "find_all(picture, target) lists what is there of a class, search(picture, target) decides",
}
"""What to call in place of a method of an agent, by its name and the option that it has not."""

_AGENT = "agent = semfov.ActivePerception.recommended(), which has search, find_all, explore, gaze and live"
PACKAGE_WORDS = {
    **dict.fromkeys(("Agent", "detect", "explore", "find", "find_all", "load", "predict", "search"), _AGENT),
    **dict.fromkeys(("plot", "show"), "record.plot(), or semfov.viz"),
    **dict.fromkeys(("imread", "open"), "semfov.read_image"),
}


AGENT_WORDS = dict.fromkeys(
    ("detect", "find", "find_objects", "locate", "predict", "run", "track"),
    "search, find_all, explore, gaze and live, or semfov.run for many pictures",
)


def missing(owner: str, name: str, words: Mapping[str, str]) -> AttributeError:
    """The error of an attribute that is not there, with ours where others have another word for it."""
    ours = words.get(name)
    return AttributeError(f"{owner} has no attribute {name!r}" + ("" if ours is None else f"; use {ours}"))


def not_there(owner: object, name: str, words: Mapping[str, str]) -> Any:
    """What `__getattr__` of a record does: a property that has failed tells its own error, another name is missing."""
    if hasattr(type(owner), name):
        return object.__getattribute__(owner, name)
    raise missing(type(owner).__name__, name, words)
