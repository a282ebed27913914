"""Other names for options and commands, from other programs; read before anything is loaded.

Each table has our words, and beside them those of others, separated by blanks.
"""

from collections.abc import Collection, Mapping


def by_word(rows: Mapping[str, str]) -> dict[str, str]:
    """Invert a table: map each word of other programs to ours."""
    return {word: ours for ours, others in rows.items() for word in others.split()}


_VERBS = ("as", "draw", "exclude", "export", "hide", "ignore", "plot", "print", "return", "save", "show", "to", "write")
"""Verbs with which others' words begin."""

NEGATIONS = ("disable", "no", "not", "without")
"""Beginnings of words that ask for the opposite of what follows."""

_LINKS = ("for",)
"""Words that mean an option where they stand alone, and nothing as a part of another word: `for`, not `wait_for`."""


def parts_of(word: str) -> list[str]:
    """List the parts of a word of several that may tell what it means, the likeliest first.

    A noun ends with what it is, and a verb stands first: `confidence_threshold` is a threshold, `save_path` saves. Each
    part is also given in the plural and in the singular.

    Args:
        word: the word, with underscores between its parts.

    Returns:
        The parts of three letters or more; none of a word of one part, or of one that asks for the opposite.
    """
    words = word.split("_")
    if words[0] in NEGATIONS:
        return []
    ends = ["_".join(words[first:]) for first in range(1, len(words))]
    beginnings = ["_".join(words[:count]) for count in range(len(words) - 1, 0, -1)]
    parts = beginnings + ends if words[0] in _VERBS else ends + beginnings
    return [
        form
        for part in parts
        if len(part) > 2 and part not in _LINKS
        for form in (part, f"{part}s", part.removesuffix("s"))
    ]


OPTIONS = by_word(
    {
        "score_threshold confirm threshold": ("conf confidence score threshold"),
        "iou": "iou iou_thres iou_threshold match_threshold nms nms_iou nms_threshold",
        "limit": "max_det max_detections max_objects topk",
        "input_size": "image_size img_size imgsz resolution",
        "min_gain": "expected_gain gain min_improvement tol tolerance",
        "stop_below": "early_stopping stop stop_threshold stopping_threshold",
        "target": (
            "class class_name classes cls filter find for label labels name object objects only prompt query targets "
            "text"
        ),
        "picture": "file image img input path photo source",
        "grid": "cells columns rows",
        "name": "detector",
        "passed": "delta dt elapsed",
        "detector name": "model yolo",
        "model": "models",
        "models model": "checkpoint ckpt",
        "host": "bind server_name share",
        "device": "gpu cuda",
        "half": "amp fp16 float16",
        "out": (
            "csv excel export figure format geojson heatmap json output overlay pdf plot png project save show svg "
            "visualise visualize"
        ),
        "report": "html page",
        "crops": "crop save_crop save_crops",
        "labels": "label_dir save_txt txt yolo_labels",
        "passes": "attempts budget iter iterations looks steps tries",
        "prior": "base_rate frequency prevalence",
        "start": "first_fixation init_fixation initial_fixation start_fixation x0",
        "seed": "generator random_state rng",
        "annotations": "ground_truth gt truth",
        "areas": "aoi aois box boxes region regions roi rois",
        "compare": "ab ab_test before_after diff difference",
        "camera": "webcam",
        "rate": "fps",
        "people": "n observers participants samples scanpaths subjects viewers",
        "shifts passes": "fixations saccades",
        "seconds": "duration time time_budget time_limit timeout",
        "workers": "jobs num_workers parallel processes threads",
        "on_look": "callback on_step",
        "looks quiet": "log_level verbose",
        "quiet": "silent",
        "batch": "batch_size",
        "classes": "names",
        "per_class": "agnostic agnostic_nms nms_per_class class_agnostic",
        "colour": "bgr channels color colours colors",
    }
)
"""Options of methods and of the command, several where the word of others can mean each of them."""

FORMER = {"least": "score_threshold", "give_up": "stop_below", "worth": "min_gain", "price": "look_cost"}
"""Present names of settings by earlier ones, which agents, `semfov.run` and the command take with a note."""


def dashed(setting: str) -> str:
    """Write the name of a setting as the option of a command, without its two dashes: `try_` is try."""
    return setting.rstrip("_").replace("_", "-")


def note_of_former(former: str, present: str) -> str:
    """Say that a setting has another name now."""
    return f"{former} is called {present} now; the earlier name will go"


SHORT = {
    "c": "confirm score_threshold",
    "d": "device",
    "i": "picture",
    "n": "passes people",
    "o": "out",
    "q": "quiet",
    "s": "picture",
    "t": "target",
    "v": "looks",
}
"""Options of the command, several where one letter of others can mean each of them, by that letter."""

COMMANDS = by_word(
    {
        "find": "analyse analyze annotate batch count detect infer label predict run segment survey",
        "gaze": "aoi attention eye-tracking fixations heat-map heatmap saliency scanpath scanpaths",
        "gaze --compare": "ab abtest diff",
        "live": "camera stream track video watch webcam",
        "fit": "calibrate finetune learn train",
        "compare": "bench benchmark eval evaluate sahi slice tile val validate",
        "detectors": "info list model models weights",
        "explore": "map scan",
        "app": "gradio gui serve ui web",
        "demo": "example examples start try",
        "mcp": "agent server tools",
    }
)
"""Commands of ours by words of others."""

_PAGE_OF_EXPORT = "the page of detectors in the documentation has the call, under Export"

_ADVICE = by_word(
    {
        "the same command goes on where it stopped": "continue restart resume",
        "what is transparent in a picture is left out": "exclude ignore mask",
        "the default detector is in the package, others are read when they are named": "download install pull setup",
        "--print-config prints the settings, and --config FILE reads them": "configure dry_run settings",
        _PAGE_OF_EXPORT: "onnx",
        "save the page as a picture first": "screenshot url webpage",
        "figures have one style; --out FILE.json has what is to be drawn otherwise": (
            "font hide_boxes hide_conf hide_labels line show_boxes show_conf show_labels thickness"
        ),
        "give all pictures to one command": "combine concat merge",
        "nothing is logged elsewhere; a tracker takes the file that --out writes": (
            "clearml comet mlflow tensorboard wandb"
        ),
    }
)

ADVICE_FOR_BOXES = by_word(
    {
        "the detector leaves out what overlaps a better box; in Python semfov.load_detector(NAME, iou=…) says when": (
            "iou iou_thres iou_threshold match_threshold nms nms_iou nms_threshold"
        ),
        "boxes of all classes suppress each other, unless --per-class is given": "agnostic agnostic_nms class_agnostic",
    }
)
"""What to do in place of an option for the boxes that a detector keeps, also where it asks for the opposite."""

_ADVICE_FOR_OBJECTS = by_word(
    {
        "semfov chooses the windows; `semfov compare` sets all slices beside it": ("overlap slice sliding tile"),
        "--out FILE.geojson has the coordinates of a GeoTIFF": "coordinates crs epsg gps latlon",
        "--out FILE.csv has all boxes, to choose by their size": "max_area max_size min_area min_size",
        "--out FILE.csv has all objects, to sort by their scores": "best k max_det max_objects sort top top_k topk",
        "--out FILE.jsonl has each picture as soon as it is done": "stream",
        "boxes of several looks become one object by themselves": "match_metric merge nmm postprocess",
        "boxes are upright, as the detector's are": "obb oriented rotated",
        "--how fovea looks with a fovea, and --sensor chooses it": "fovea fovea_radius fovea_size foveal_radius",
        "semfov looks again where that pays": "augment tta",
        "in Python an agent is made with it: semfov.ActivePerception.recommended(grid=…)": "cells columns grid rows",
        "the agent has one; in a checkout `python -m eval.search --help` compares several": (
            "acquisition policies policy strategy"
        ),
    }
)

_ADVICE_FOR_GAZE = by_word(
    {
        "the map keeps the picture's colours; --out FOLDER writes it beside a table": (
            "alpha cmap colormap colourmap opacity transparency"
        ),
        "the model is of adults without a task; `semfov fit --help` has that of your viewers": (
            "age audience gender persona"
        ),
        "the places are printed by their shares, the largest first": "k peaks sort top top_k topk",
        "--seconds says how long a viewer looks": "fixations saccades shifts",
        "the fitted model has its own centre bias and blur": (
            "blur center_bias centerbias centre_bias distance dva pixel_per_degree pixels_per_degree ppd screen sigma "
            "temperature viewing_distance"
        ),
    }
)

ADVICE = {**_ADVICE, **_ADVICE_FOR_OBJECTS, **_ADVICE_FOR_GAZE, "export": _PAGE_OF_EXPORT}
"""What to do in place of an option or a command that others have, and `semfov` has not."""

ADVICE_OF = {
    **{command: {**_ADVICE, **ADVICE_FOR_BOXES, **_ADVICE_FOR_OBJECTS} for command in ("search", "find", "explore")},
    "app": ADVICE_FOR_BOXES,
    "gaze": {**_ADVICE, **ADVICE_FOR_BOXES, **_ADVICE_FOR_GAZE},
    "live": {
        **_ADVICE,
        **ADVICE_FOR_BOXES,
        **by_word(
            {
                "each frame is looked at; live.step in Python takes the frames that you choose": "skip stride",
                "objects keep their numbers by themselves; --tracks FILE writes them": "persist track tracker tracking",
            }
        ),
    },
    "compare": {
        **ADVICE_FOR_BOXES,
        **by_word(
            {
                "--out FOLDER has compare.html, compare.csv and compare.png": "html page report",
                "AP50 is compared over passes and seconds": "map map50 metric metrics",
            }
        ),
    },
}
"""The same for the options of each command."""

FROM_YOLO = "supervision.DetectionDataset.from_yolo(…).as_coco(annotations_path=…) writes them in COCO's format"
"""How labels of YOLO become annotations in COCO's format."""

SWITCHED_OFF = {"closer": "--closer 0", "draw": "--draw none"}
"""How a command is told not to do what an option is for, where leaving the option out does not say it."""

_LOOKING = ("search", "find_all", "explore")

_OF_TARGETS = "find_all(picture, target) lists what is there of a class, search(picture, target) decides"
_OF_VIEWERS = "gaze.scanpaths(people, seconds=…) draws viewers from a prediction"
_OF_FRAMES = "live.step(frame) takes the frames"
_OTHER_METHODS = {
    ("explore", "target"): _OF_TARGETS,
    ("gaze", "target"): _OF_TARGETS,
    ("gaze", "people"): _OF_VIEWERS,
    ("gaze", "seconds"): _OF_VIEWERS,
    **dict.fromkeys(
        # What is given to `describe` without a name is taken for a target.
        [("gaze", "areas"), ("describe", "areas"), ("describe", "target")],
        "gaze.share(areas) and gaze.visits(areas) are of a prediction",
    ),
    ("scanpaths", "shifts"): "seconds= says how long a viewer looks",
    ("live", "picture"): _OF_FRAMES,
    ("live", "stream"): _OF_FRAMES,
    ("semfov find", "stream"): "out='FILE.jsonl' has each picture as soon as it is done",
    ("search", "policy"): "explore takes one, and semfov.rollout one of yours",
    **dict.fromkeys(
        [("search", "temperature"), ("explore", "temperature")], "semfov.gaze.Softmax is for semfov.rollout"
    ),
    **dict.fromkeys(
        [("gaze", "center_bias"), ("gaze", "centerbias"), ("gaze", "centre_bias")],
        "the fitted model has its own; gaze.parts tells what it adds",
    ),
    **dict.fromkeys(
        [("semfov search", "iou"), ("semfov find", "iou"), ("semfov explore", "iou")],
        "an agent is made with it: agent=semfov.ActivePerception.recommended(iou=…)",
    ),
}
"""What to call in place of a method of an agent, by its name and the option that it has not."""

_OF_DETECTORS = ("iou", "limit", "input_size", "device", "weights", "per_class", "classes", "grid")
"""Options that an agent is made with, and not a look."""

_OTHER_PLACES = by_word(
    {
        "semfov chooses the windows, so none are cut; `semfov compare` sets all slices beside it": (
            "auto_slice_resolution overlap perform_standard_pred slice tile"
        ),
        "the record has what is to be written and shown: record.report(path), record.plot(), record.to_csv(path)": (
            "csv export format html json out output plot project report save show tensorboard visualize wandb"
        ),
        "record.objects has all, to sort by their scores": "best k sort top top_k topk",
        "record.belief_map(-1), of looks by a fovea or a head": "belief_map heat_map heatmap",
        "agent.live(target).step(frame) takes the frames of a stream": "stream video vid_stride",
        "leave it out, as nothing is printed; on_look= is called after each look": "progress quiet verbose",
        "a whole list is looked at by semfov.run(pictures, target, workers=)": "batch_size jobs num_workers workers",
        "color='bgr' says that an array is BGR": "bgr channels",
        "what is transparent in a picture is left out": "exclude ignore mask roi",
        "semfov.run(pictures, target, out=FILE) goes on where it stopped": "restart resume",
        "agent.half() makes numbers of 16 bits of a detector of PyTorch": "float16 fp16 half",
    }
)
"""What to do in place of an option of a look that others have."""


def meant_options(word: str, known: Collection[str]) -> list[str]:
    """Find the options that a word of others, or an earlier name, means.

    Args:
        word: the word.
        known: names of the options that there are.

    Returns:
        Those of our names that are known, among them the word itself; none where the word is not listed.
    """
    meant = FORMER.get(word) or OPTIONS.get(word, word)
    return [option for option in meant.split() if option in known]


def other_method(method: str, option: str, known: Collection[str]) -> str | None:
    """Say what has an option which a method of an agent has not: another method, the agent, or its record.

    Args:
        method: name of the method.
        option: the option.
        known: names of the options of the method.

    Returns:
        The advice; None if there is none.
    """
    meant = (option, *OPTIONS.get(option, "").split())
    for word in meant:
        if (method, word) in _OTHER_METHODS:
            return _OTHER_METHODS[method, word]
    if method not in _LOOKING or meant_options(option, known):
        return None
    if option in _OTHER_PLACES:
        return _OTHER_PLACES[option]
    for word in meant:
        if word in _OF_DETECTORS:
            return f"an agent is made with it: semfov.ActivePerception.recommended({word}=…)"
    return None


MAKERS = {"ActivePerception": "ActivePerception.recommended()"}
"""Calls that make what a class makes of parts, by its name."""
