"""What others, and other programs, call an option or an attribute; the command reads it before it loads anything.

Each table has our words, and beside them those of others, separated by blanks.
"""

import warnings
from collections.abc import Collection, Iterable, Mapping
from difflib import get_close_matches
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn


def _by_word(rows: Mapping[str, str]) -> dict[str, str]:
    """Our words by each of the words of others."""
    return {word: ours for ours, others in rows.items() for word in others.split()}


_VERBS = ("as", "draw", "exclude", "export", "hide", "ignore", "plot", "print", "return", "save", "show", "to", "write")
"""Verbs with which others' words begin."""

NEGATIONS = ("disable", "no", "not", "without")
"""Beginnings of words that ask for the opposite of what follows."""


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
    return [form for part in parts if len(part) > 2 for form in (part, f"{part}s", part.removesuffix("s"))]


OPTIONS = _by_word(
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

COMMANDS = _by_word(
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

_ADVICE = _by_word(
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

_ADVICE_FOR_BOXES = _by_word(
    {
        "the detector leaves out what overlaps a better box; in Python semfov.load_detector(NAME, iou=…) says when": (
            "iou iou_thres iou_threshold match_threshold nms nms_iou nms_threshold"
        ),
        "boxes of all classes suppress each other, unless --per-class is given": "agnostic agnostic_nms class_agnostic",
    }
)

_ADVICE_FOR_OBJECTS = _by_word(
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

_ADVICE_FOR_GAZE = _by_word(
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
    **{command: {**_ADVICE, **_ADVICE_FOR_BOXES, **_ADVICE_FOR_OBJECTS} for command in ("search", "find", "explore")},
    "app": _ADVICE_FOR_BOXES,
    "gaze": {**_ADVICE, **_ADVICE_FOR_BOXES, **_ADVICE_FOR_GAZE},
    "live": {
        **_ADVICE,
        **_ADVICE_FOR_BOXES,
        **_by_word(
            {
                "each frame is looked at; live.step in Python takes the frames that you choose": "skip stride",
                "objects keep their numbers by themselves; --tracks FILE writes them": "persist track tracker tracking",
            }
        ),
    },
    "compare": {
        **_ADVICE_FOR_BOXES,
        **_by_word(
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
    ("gaze", "areas"): "gaze.share(areas) and gaze.visits(areas) are of a prediction",
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
}
"""What to call in place of a method of an agent, by its name and the option that it has not."""

_OF_DETECTORS = ("iou", "limit", "input_size", "device", "weights", "per_class", "classes", "grid")
"""Options that an agent is made with, and not a look."""

_OTHER_PLACES = _by_word(
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

PACKAGE = _by_word(
    {
        "agent = semfov.ActivePerception.recommended(), which has search, find_all, explore, gaze and live": (
            "Agent Model ObjectDetector Pipeline Predictor Searcher detect explore find find_all inference load "
            "predict search"
        ),
        "record.plot(), or semfov.viz": "plot show",
        "seed= of a search or an exploration, or torch.manual_seed": "manual_seed seed seed_everything set_seed",
        "semfov.envs, whose environments gymnasium.make knows": (
            "Env FoveatedEnv GazeEnv SearchEnv env environment environments make make_env"
        ),
        "semfov.read_image": "imread load_image open",
        "semfov.data, which reads pictures, COCO's annotations and fixations": (
            "CocoDetection DataLoader Dataset dataset datasets load_dataset"
        ),
        "semfov.sensor, whose modules take pictures": (
            "Fovea Foveate Transform Transforms augmentation fovea transforms"
        ),
        "semfov.viz, or record.report(path)": "draw visualization visualize",
        "semfov.load_detector(name or file), or semfov.ActivePerception.recommended(name)": (
            "AutoDetectionModel AutoModel Detector YOLO from_pretrained get_model load_model pipeline"
        ),
        "semfov.ActivePerception.recommended().find_all(picture, target), which chooses its windows": (
            "InferenceSlicer count get_prediction get_sliced_prediction slice_image"
        ),
        "semfov.ActivePerception.recommended().gaze(picture)": "DeepGaze DeepGazeIIE gaze heatmap saliency_map",
        "`semfov detectors` in a shell": "detectors list_detectors list_models models",
        "semfov.fusion, or semfov.DirichletBelief": "kaplan kaplan_update update_belief",
        "`semfov demo` in a shell": "demo",
        "`semfov compare FOLDER --with sahi` in a shell": "benchmark compare evaluate",
        "semfov.fit_detector(model, photographs, annotations)": "finetune fit train",
        "semfov.data.fixations, which reads those of people": "fixations read_fixations",
    }
)

AGENT = _by_word(
    {
        "search, find_all, explore, gaze and live, or semfov.run for many pictures": (
            "analyse analyze batch detect detect_all find find_everything find_objects infer locate look predict run"
        ),
        "len(agent.find_all(picture, target).objects), and record.expected with what was not seen": (
            "count count_all count_objects"
        ),
        "the target of search or find_all: a class, or several": "set_classes set_target",
        "agent.gaze(picture)": (
            "attention fixations heat_map heatmap predict_gaze predict_saliency saliency saliency_map scanpath "
            "scanpaths where_people_look"
        ),
        "agent.gaze(picture), which has share(areas) and visits(areas)": "aoi aois areas regions roi rois",
        "semfov.ActivePerception.from_pretrained(folder)": "load",
        "semfov.fit_detector(model, photographs, annotations)": "finetune fit",
        "a new call, as an agent keeps nothing of earlier pictures": "clear close reset",
        "semfov.run(folder, target)": "find_folder find_in_folder run_folder search_folder",
        "record.belief_map(-1), of looks by a fovea or a head": "belief beliefs posterior",
        "agent.explore(picture, policy=…), or semfov.rollout with one of yours": "act policy select_action",
        "agent.live(target), whose step takes frames": "step stream track update video watch webcam",
        "agent.classes[1:]": "class_names labels names",
        "agent.eye.detector": "detector model",
        "next(agent.parameters()).device": "device",
        "agent.requires_grad_(False)": "freeze",
        "print(agent)": "describe info summary",
        "semfov.fit_detector, which writes a folder of models, and semfov.ActivePerception.from_pretrained(folder)": (
            "export save save_model save_pretrained"
        ),
    }
)

CALLS = {
    "semfov.gaze": "semfov.ActivePerception.recommended().gaze(picture)",
    "semfov.live": "semfov.ActivePerception.recommended().live(target)",
    "semfov.report": "record.report(path)",
    "semfov.saliency": "semfov.ActivePerception.recommended().gaze(picture)",
}
"""What to call in place of a module, by its name."""

DECISION = _by_word(
    {
        "decision.outcome == 'found'": "found is_found is_present present result success",
        "decision.probability": "conf confidence p presence prob score",
        "decision.box": "bbox boxes xyxy",
        "record.found_at": "at location point position x y",
    }
)

LIVE = _by_word(
    {
        "live.step(frame)": "detect forward next predict process push read run track update",
        "the release of your own capture, as nothing else is open": "close release stop",
        "the moment that live.step(frame) returns": "boxes decision objects tracks",
    }
)

OBJECTS = _by_word(
    {
        "objects.boxes, which are corners: objects.boxes[:, 2:] - objects.boxes[:, :2] are their sizes": (
            "area areas height sizes width xywh"
        ),
        "objects.above(score), or objects.of(name)": "filter select where",
        "(objects.boxes[:, :2] + objects.boxes[:, 2:]) / 2": "center centers centre centres centroids",
        "objects[objects.scores.argsort(descending=True)]": "best sort sorted top top_k topk",
        "objects.boxes, as the detector has no masks": "mask masks segmentation",
        "len(objects.of(name)), or record.expected with what was not seen": "count",
        "the objects as they are, as each has one box already": "nms with_nms with_nmm",
        "record.to_csv(path, 'objects')": "save to_csv write",
        "record.to_frame('objects')": "dataframe df to_dataframe to_df to_frame to_pandas",
        "record.object_rows()": "to_dict to_json tolist",
        "record.to_coco()": "to_coco",
        "record.to_geojson()": "to_geojson",
        "record.to_supervision()": "sv to_supervision",
        "record.to_yolo()": "to_yolo",
        "record.to_yolo(), in shares of the picture": "xywhn xyxyn",
        "record.plot()": "draw plot show",
        "objects.boxes": "bbox box xyxy",
        "objects.scores": "conf confidence probability score",
        "objects.labels": "class_id cls label",
        "objects.classes": "class_names names",
        "objects.boxes, objects.scores and objects.labels, which are tensors": "cpu cuda data detach numpy tensor",
    }
)

RECORD = _by_word(
    {
        "its objects, such as record.objects.boxes": "bboxes boxes labels scores xyxy",
        "record.objects.scores, or record.decision.probability": "conf confidences probs",
        "record.to_supervision()": "as_detections as_supervision supervision sv to_detections to_sv to_sv_detections",
        "record.decision.box, or its objects, record.objects.boxes": "box",
        "record.decision.probability": "confidence prob probability score",
        "record.decision.outcome": "answer outcome result",
        "len(record.objects), or record.expected with what was not seen": (
            "count counts n n_detections n_objects num_boxes num_detections num_objects number total"
        ),
        "record.to_frame()": "dataframe df to_dataframe to_df to_excel to_pandas",
        "record.why_it_ended()": "reason stop_reason stopped why",
        "record.looks": "history slices steps tiles windows",
        "len(record)": "n_fixations n_looks n_steps num_fixations num_looks num_steps",
        "record.objects.boxes, as the detector has no masks": "mask masks segmentation",
        "record.objects.above(score), or record.objects.of(name)": "filter select where",
        "record.objects, to sort by their scores": "best sort sorted top top_k topk",
        "record.expected_error, and record.objects.scores": "std uncertainties uncertainty",
        "record.rows(), which has the value of each look": "gains reward rewards values",
        "record.plot()": "annotate annotated draw render show visualise visualize",
        "record.classes": "names",
        "record.objects, or the detections of a look, record[0].detections": (
            "detections object_prediction_list predictions results"
        ),
        "record.report(path)": "to_html save_html",
        "record.decision.box": "bbox",
        "record.found, or record.decision.outcome": "is_present present success",
        "record.objects.labels": "class_id cls label",
        "record.to_yolo(path)": "save_labels save_txt",
        "record.plot().savefig(path)": "export_visuals save_plot savefig",
        "record.object_rows()": "objects_table to_json_list tolist",
        "record.save(path), record.to_csv(path), record.to_json(path) or record.report(path)": "export write",
        "semfov.run(picture, target, crops=FOLDER)": "crop save_crop save_crops",
        "record.rows(), which has the seconds of each look": "duration elapsed speed time times timing",
        "record.objects.track_ids, of a stream": "id ids track_id tracker_id",
        "[look.fixation for look in record]": "actions fixations gaze path saccades scanpath sequence trajectory",
        "record.belief_map(-1), of looks by a fovea or a head": (
            "belief beliefs entropy heat_map heatmap logits map posterior probabilities"
        ),
    }
)

LOOK = _by_word(
    {
        "look.detections; record.objects has those of all looks together": (
            "boxes conf detections labels masks object_prediction_list objects obb predictions probs scores xyxy"
        ),
        "look.fixation": "action gaze location place point position x xy y",
        "look.region": "bbox box crop roi window",
        "look.value": "gain reward score",
        "look.seconds": "duration speed time",
        "look.number": "id step",
        "record.plot(), or record.report(path)": "draw plot save save_txt show",
    }
)

METRICS = _by_word(
    {
        "semfov.metrics.scanpath": (
            "AUC CC IG KL NSS SIM auc auc_judd cc edit_distance ig information_gain kl kl_div kldiv multimatch nss "
            "scanmatch sequence_score sim similarity"
        ),
        "semfov.metrics.calibration": "Calibration ECE calibration_error ece reliability",
        "semfov.metrics.average_precision": ("AP AveragePrecision MeanAveragePrecision ap ap50 mAP map map50"),
        "semfov.metrics.episodes": "area_under_roc cumulative_performance roc_auc standard_error",
    }
)

GAZE_PREDICTION = _by_word(
    {
        "gaze.plot()": "draw overlay show visualize",
        "gaze.plot().savefig(path)": "save_plot savefig",
        "gaze.first_fixations()": "first first_fixation order sequence top",
        "gaze.peaks()": "hotspots peak places",
        "gaze.save_density(path), gaze.report(path) or gaze.to_csv(path)": (
            "export save to_frame to_json to_pandas to_png"
        ),
        "gaze.density.numpy()": "array cpu numpy tensor",
        "gaze.density": "fixation_map heat_map heatmap map probability saliency saliency_map",
        "semfov.paths.Drafts(gaze, other)": "ab diff difference versus",
        "gaze.density.log()": "log_density log_probability logits",
        "gaze.scanpaths(people)": "fixations sample sample_scanpaths scanpath",
        "gaze.visits(areas)": "noticed seen_by time_to_first_fixation ttff viewers",
        "gaze.share(areas)": "aoi aois area attention dwell dwell_time region regions roi rois shares",
        "`from semfov.metrics.scanpath import nss, auc, correlation`": "auc cc evaluate nss score",
    }
)


def missing(
    owner: str, name: str, words: Mapping[str, str], known: Iterable[str] = (), of_class: str = ""
) -> AttributeError:
    """Make the error of an attribute that is not there, with ours where others have another word for it.

    Args:
        owner: what has no such attribute.
        name: the attribute.
        words: our words by those of others, such as `RECORD`.
        known: the attributes that there are, of which near ones are suggested.
        of_class: what has the objects of a class, where the name is that of one.

    Returns:
        The error, to raise.
    """
    attributes = tuple(known)
    remedy = _use(words.get(name, of_class)) or _near(name, attributes)
    for part in [] if name.startswith("_") else parts_of(name):
        remedy = remedy or _use(words.get(part, part if part in attributes else ""))
    return AttributeError(f"{owner} has no attribute {name!r}{remedy}")


def _use(ours: str) -> str:
    """Say what to use; empty where there is nothing."""
    return f"; use {ours}" if ours else ""


@lru_cache(maxsize=1024)  # a parser of options asks the package for the same dozens of names at every command
def _near(name: str, known: tuple[str, ...]) -> str:
    """Suggest the public names that are near to one; empty if there are none, or it is a private one."""
    if name.startswith("_"):  # which programs ask for, and not people
        return ""
    similar = get_close_matches(name, [word for word in known if not word.startswith("_")], n=2, cutoff=0.7)
    return f"; did you mean {' or '.join(similar)}?" if similar else ""


class Room(ModuleType):
    """A module that answers a call with what is meant (`CALLS`)."""

    def __call__(self, *arguments: object, **options: object) -> NoReturn:
        raise TypeError(f"{self.__name__} is a module, which is not called; use {CALLS[self.__name__]}")


class OtherWords:
    """Base of classes that answer others' words for their attributes with ours (`_other_words`).

    Those that hold objects also answer the name of a class, with what has its objects (`_objects`).
    """

    _other_words: ClassVar[Mapping[str, str]]
    _objects: ClassVar[str] = ""

    if not TYPE_CHECKING:  # to which any name would be an attribute

        def __getattr__(self, name: str) -> Any:
            if hasattr(type(self), name):
                return object.__getattribute__(self, name)  # a property that has failed tells its own error
            present = FORMER.get(name)
            if present is not None and hasattr(self, present):
                warnings.warn(note_of_former(name, present), FutureWarning, stacklevel=2)
                return getattr(self, present)
            raise missing(type(self).__name__, name, self._other_words, dir(type(self)), self._of_class(name))

        def _of_class(self, name: str) -> str:
            """Say what has the objects of a class, whose name may be in the plural; empty for other names."""
            classes = vars(self).get("classes", ())
            named = get_close_matches(name.replace("_", " "), classes, n=1, cutoff=0.8) if self._objects else []
            return f"{self._objects}.of({named[0]!r})" if named else ""
