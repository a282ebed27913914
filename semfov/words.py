"""What others, and other programs, call an option or an attribute; the command reads it before it loads anything.

Each table has our words, and beside them those of others, separated by blanks.
"""

import warnings
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any, ClassVar


def _by_word(rows: Mapping[str, str]) -> dict[str, str]:
    """Our words by each of the words of others."""
    return {word: ours for ours, others in rows.items() for word in others.split()}


OPTIONS = _by_word(
    {
        "score_threshold confirm": "conf conf_thres confidence min_score score threshold",
        "min_gain": "expected_gain gain min_improvement tol tolerance",
        "stop_below": "stop stop_threshold stopping_threshold",
        "target": "class class_name classes cls label labels name query targets",
        "picture": "file image img path photo source",
        "grid": "cells columns rows",
        "detector": "model yolo",
        "model": "models",
        "device": "gpu cuda",
        "half": "fp16 float16",
        "out": "csv figure format json output pdf plot png project save show svg",
        "report": "html page",
        "crops": "crop save_crop save_crops",
        "labels": "label_dir save_txt txt yolo_labels",
        "passes": "budget iterations looks max_passes max_steps n steps",
        "shifts passes": "fixations max_fixations max_shifts n_fixations saccades",
        "seconds": "max_seconds time time_limit timeout",
        "workers": "jobs num_workers processes threads",
        "on_look": "callback on_step",
        "looks quiet": "verbose",
        "quiet": "silent",
        "batch": "batch_size",
        "classes": "names",
        "per_class": "agnostic agnostic_nms nms_per_class class_agnostic",
        "colour": "bgr channels color colours colors",
    }
)
"""Options of methods and of the command, several where the word of others can mean each of them."""

FORMER = {"least": "score_threshold", "give_up": "stop_below", "worth": "min_gain", "price": "look_cost"}
"""Present names of settings by those that they had in earlier versions, which are still taken, with a note."""


def note_of_former(former: str, present: str) -> str:
    """Say that a setting has another name now."""
    return f"{former} is called {present} now; the earlier name will go"


_OTHER_METHODS = {
    ("explore", "target"): "find_all(picture, target) lists what is there of a class, search(picture, target) decides",
}
"""What to call in place of a method of an agent, by its name and the option that it has not."""


def meant_options(word: str, known: Collection[str]) -> list[str]:
    """Find the options that a word of others means.

    Args:
        word: the word.
        known: names of the options that there are.

    Returns:
        Those of our names that are known; none where the word is not listed.
    """
    return [option for option in OPTIONS.get(word, "").split() if option in known]


def other_method(method: str, option: str) -> str | None:
    """Name the method of an agent that has an option which this one has not; None if there is none."""
    return _OTHER_METHODS.get((method, option))


PACKAGE = _by_word(
    {
        "agent = semfov.ActivePerception.recommended(), which has search, find_all, explore, gaze and live": (
            "Agent detect explore find find_all load predict search"
        ),
        "record.plot(), or semfov.viz": "plot show",
        "semfov.read_image": "imread open",
    }
)

AGENT = _by_word(
    {
        "search, find_all, explore, gaze and live, or semfov.run for many pictures": (
            "detect find find_objects locate predict run track"
        ),
    }
)

DECISION = _by_word(
    {
        "decision.outcome == 'found'": "found present result success",
        "decision.probability": "conf confidence p score",
        "decision.box": "bbox boxes xyxy",
        "record.found_at": "at location point x y",
    }
)

OBJECTS = _by_word(
    {
        "record.to_csv(path, 'objects')": "save to_csv write",
        "record.to_frame('objects')": "dataframe df to_dataframe to_df to_frame to_pandas",
        "record.object_rows()": "to_dict to_json tolist",
        "the method of the record": "to_coco to_geojson to_supervision to_yolo",
        "record.plot()": "draw plot show",
        "objects.boxes": "bbox box xyxy",
        "objects.scores": "conf confidence probability score",
        "objects.labels": "class_id cls label",
        "objects.classes": "names",
    }
)

RECORD = _by_word(
    {
        "its objects, such as record.objects.boxes": "boxes labels scores xyxy",
        "record.decision.box, or its objects, record.objects.boxes": "box",
        "record.decision.probability": "confidence probability score",
        "record.decision.outcome": "outcome result",
        "len(record.objects), or record.expected with what was not seen": "count counts number",
        "record.to_frame()": "dataframe df to_dataframe to_df to_pandas",
        "record.plot()": "draw show visualize",
        "record.classes": "names",
        "record.objects, or the detections of a look, record[0].detections": "detections results",
        "record.report(path)": "to_html save_html",
    }
)

GAZE_PREDICTION = _by_word(
    {
        "gaze.plot()": "draw show visualize",
        "gaze.save_density(path), gaze.report(path) or gaze.to_csv(path)": "save to_png",
        "gaze.density": "heatmap map saliency",
        "gaze.scanpaths(people)": "fixations sample scanpath",
    }
)


def missing(owner: str, name: str, words: Mapping[str, str]) -> AttributeError:
    """Make the error of an attribute that is not there, with ours where others have another word for it.

    Args:
        owner: what has no such attribute.
        name: the attribute.
        words: our words by those of others, such as `RECORD`.

    Returns:
        The error, to raise.
    """
    remedy = f"; use {words[name]}" if name in words else ""
    return AttributeError(f"{owner} has no attribute {name!r}{remedy}")


class OtherWords:
    """Base of classes that answer others' words for their attributes with ours (`_other_words`)."""

    _other_words: ClassVar[Mapping[str, str]]

    if not TYPE_CHECKING:  # to which any name would be an attribute

        def __getattr__(self, name: str) -> Any:
            if hasattr(type(self), name):
                return object.__getattribute__(self, name)  # a property that has failed tells its own error
            present = FORMER.get(name)
            if present is not None and hasattr(self, present):
                warnings.warn(note_of_former(name, present), FutureWarning, stacklevel=2)
                return getattr(self, present)
            raise missing(type(self).__name__, name, self._other_words)
