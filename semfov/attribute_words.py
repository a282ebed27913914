"""Other names for attributes of the package, an agent or a record; the error message names the right one.

Each table has our words, and beside them those of others, separated by blanks.
"""

import warnings
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, NoReturn

from semfov.words import FORMER, by_word, note_of_former, parts_of

PACKAGE = by_word(
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
        "semfov.Foveation, a module, or semfov.foveate": "Fovea Foveate fovea",
        "semfov.sensor, whose modules take pictures": "Transform Transforms augmentation transforms",
        "semfov.Foveation, semfov.FovealObservationModel and semfov.observers, which are modules of PyTorch": (
            "layers modules nn"
        ),
        "semfov.head.PanTiltCamera, from which yours derives": "Camera PTZCamera PanTiltCamera PtzCamera",
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

AGENT = by_word(
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
        "semfov.paths.Drafts(agent.gaze(first), agent.gaze(second)), or `semfov compare FOLDER` in a shell": (
            "benchmark compare diff evaluate"
        ),
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

DECISION = by_word(
    {
        "decision.outcome == 'found'": "found is_found is_present present result success",
        "decision.probability": "conf confidence p presence prob score",
        "decision.box": "bbox boxes xyxy",
        "record.found_at": "at location point position x y",
    }
)

LIVE = by_word(
    {
        "live.step(frame)": "detect forward next predict process push read run track update",
        "a new agent.live(target), which knows nothing of earlier frames": "clear reset restart",
        "the release of your own capture, as nothing else is open": "close release stop",
        "the moment that live.step(frame) returns": "boxes decision objects tracks",
    }
)

OBJECTS = by_word(
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

RECORD = by_word(
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

LOOK = by_word(
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

MOMENT = {**RECORD, **dict.fromkeys(["fixation", "gaze"], "moment[-1].fixation")}
"""Those of a frame whose windows are looked at."""

BELIEF = by_word(
    {
        "belief.class_probabilities(), or belief.probability(target)": (
            "logits mean posterior posteriors prob probs softmax"
        ),
        "belief.class_probabilities(), or semfov.dirichlet.entropy(belief.beta) of a Dirichlet belief": (
            "entropy uncertainty"
        ),
        "observer(belief, detections, fixation, grid), which returns the new belief": "fuse observe step update",
        "belief.map(lambda tensor: tensor.to(device))": "cpu cuda double float half to",
    }
)

MODEL = by_word({"model.save(path)": "export save_pretrained"})
"""Of models that are fitted and saved."""

OBSERVATION_MODEL = MODEL | by_word(
    {
        "len(model.classes)": "n_classes nc num_classes",
        "model.classes": "class_names labels names",
    }
)

POLICIES = by_word({"semfov.policies.policy_names(task)": "POLICIES all available known list list_policies names"})

METRICS = by_word(
    {
        "semfov.metrics.scanpath": (
            "AUC CC IG KL NSS SIM auc auc_judd cc edit_distance ig information_gain kl kl_div kldiv multimatch nss "
            "scanmatch sequence_score sim similarity"
        ),
        "semfov.metrics.calibration": "Calibration ECE calibration_error ece reliability",
        "semfov.metrics.average_precision": ("AP AveragePrecision MeanAveragePrecision ap ap50 mAP map map50"),
        "semfov.metrics.episodes": (
            "CP CumulativePerformance area_under_roc cp cumulative_performance roc_auc standard_error"
        ),
    }
)

GAZE_PREDICTION = by_word(
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
        "agent.find_all(picture, target)": "detect find find_all search",
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
    """Make the error for a missing attribute, which names our attribute if the name is a known synonym.

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
    """A module whose call raises an error that names the function to call instead (`CALLS`)."""

    def __call__(self, *arguments: object, **options: object) -> NoReturn:
        raise TypeError(f"{self.__name__} is a module, which is not called; use {CALLS[self.__name__]}")


class OtherWords:
    """Base of classes whose errors name the right attribute for a known synonym (`_other_words`).

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
