"""Every number in a sentence of README and docs is in a table, or it is listed here with its reason.

A number of a sentence is carried by a cell of a table of its page, of a page that its paragraph links to, or of a page
that belongs to its own (`COMPANIONS`). The paragraph must say half of the words of the row, and a word of the column
(`SAME` has other words for them). The number may be rounded, a share may be a percentage, and a difference of two such
numbers of the sentence is carried, too. Text in code, links and formulas is left out, and so are conditions
(`CONDITIONS`): sizes of pictures, numbers of looks, years. Where a sentence fails, correct it from its table, or say in
its paragraph which row and column it means.
"""

import re
from dataclasses import dataclass
from functools import cache
from math import log
from pathlib import Path

import pytest
import torch

from examples.look_graph import OPSET
from semfov import FovealObservationModel
from semfov.agents.fovea import RATE as FOVEA_RATE
from semfov.agents.head import _CONFIRM
from semfov.agents.window_episode import LIKELY
from semfov.agents.windows import RATE as WINDOW_RATE
from semfov.belief import Verification
from semfov.data.inputs import FRAME
from semfov.decision import MOST_CLOSER
from semfov.detection.class_names import COCO_CLASSES
from semfov.detection.detector import FAINT
from semfov.detection.objects import FAINTEST, SCORE_THRESHOLD
from semfov.head import Speeds
from semfov.runs.config import BeliefConfig, DataConfig, DetectorConfig
from semfov.sensor.log_polar import _Retina
from semfov.zoom.closer import USUAL_WINDOW, PhotographPlaces
from semfov.zoom.eye import _PHOTOGRAPH_BORDER
from tests.test_house_rules import MOST_LINES

ROOT = Path(__file__).parents[1]

STRICT = [
    "README.md",
    *(f"docs/{name}.md" for name in ("results", "tables", "zoom", "head", "human", "detectors")),
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/decisions/*.md")),
]
"""Pages whose sentences repeat what tables say."""

OTHERS = [
    *(
        f"docs/{name}.md"
        for name in ("searchers", "sensors", "pan-tilt", "testing", "command", "glossary", "method", "words")
    ),
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/measurements/*.md")),
    *sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/guides/*.md")),
]
"""Pages on which a number may also be the output of a command that its section names (`COMMAND`)."""

COMMAND = re.compile(r"python -m|`(?:eval|train|benchmarks)\.|`semfov fit|commit [0-9a-f]{7}")

COMPANIONS = {
    "README.md": [
        "docs/results.md",
        "docs/tables.md",
        "docs/measurements/zoom.md",
        "docs/detectors.md",
        "docs/guides/gaze-prediction.md",
        "docs/measurements/human.md",
    ],
    "docs/results.md": ["docs/tables.md"],
    "docs/tables.md": ["docs/results.md"],
    "docs/decisions/closer_looks.md": ["docs/results.md", "docs/tables.md"],
    "docs/decisions/tempering.md": ["docs/results.md", "docs/tables.md"],
    "docs/zoom.md": ["docs/measurements/zoom.md"],
    "docs/head.md": ["docs/measurements/head.md"],
    "docs/human.md": ["docs/measurements/human.md"],
    "docs/detectors.md": ["docs/measurements/detectors.md"],
}
"""Pages with the tables of a page."""

_COUNTED = (
    r"(?:(?:gaze |first |aerial |street |fitted |neighbouring )*(?:shifts?|saccades?|pass(?:es)?|looks?|photographs?|"
    r"pictures?|mosaics?|panoramas?|people|classes|cells|starts|searches|boxes|words|dimensions|fixations?|windows|images))"
)
CONDITIONS = re.compile(
    r"\d[\d,]* ?× ?\d[\d,]*"  # sizes
    r"|\d[\d,.]* ?(?:px|million pixels|pixels|degrees|°)|of 640\b"  # lengths in pixels, and angles
    r"|\b(?:1[89]|20)\d\d(?=[),;.])"  # years of publications
    r"|\b95 %(?= (?:intervals?|limit)\b)"  # levels of errors
    r"|\d+e-\d+|10⁻⁶|ln 2 / r"  # tolerances, and half-lives
    rf"|(?:[Aa]fter|[Ww]ithin) \d+(?:, \d+)*(?: and \d+)*(?: of \d+)? {_COUNTED}\b"
    rf"|(?:[Ii]n|[Oo]n|[Aa]t|[Ff]or|[Oo]f|[Ww]ith|[Oo]ver|to|the) (?:the |all |both |first )*\d[\d,]* {_COUNTED}\b"
    r"|(?:[Aa]t|[Ww]hy|for|from|is|of) 0\.(?:005|02|1|25|5)\b(?:, 0\.\d+)*(?: and 0\.\d+)?"  # thresholds of scores
    r"|95 % intervals"
    r"|(?:[Gg]rowth|[Rr]ate(?: is| of)?|[τκσ] =|τ <|temperature|threshold of) \d+(?:\.\d+)?"  # settings by name
)
"""What a sentence is about, as opposed to what was measured: sizes, numbers of looks, years, settings by name."""

NUMBER = re.compile(r"(?<![\w.,])[+−-]?\d(?:[\d,]*\d)?(?:\.\d+)?(?![\w]|[.,]\d)")
HIDDEN = re.compile(
    r"```.*?```|<!--.*?-->|`[^`]*`|\$[^$]*\$|(?<=\])\([^)]*\)|https?://\S+|^(?: {4}|#)[^\n]*", re.DOTALL | re.M
)
LINK = re.compile(r"\]\(([^)#\s]+\.md)?(#[\w-]+)?\)")

_DATA, _DETECTOR, _SPEEDS = DataConfig(), DetectorConfig(), Speeds()
_COUNTS = torch.tensor(FovealObservationModel.from_pretrained("yolox-nano-published-narrow").metadata["counts"])
_VERIFICATION = Verification.from_pretrained("yolox-nano")
_RINGS, _WEDGES = _Retina(60.0).receptors((640, 480))
_OBJECTS, _DETECTIONS = _COUNTS[1:].sum(0).tolist(), _COUNTS.sum(0).tolist()

KNOWN = {
    "README.md": {
        "Python 3.11": "pyproject.toml; test_project.py compares the workflows with it",
        "After 15 looks": "what python -m eval.readme_picture draws",
        "22 people, 19 of them rightly; 41 are there": "the same",
        "500 pictures of OSIE": "size of the data set",
        f"COCO's {len(COCO_CLASSES)} classes": "code",
    },
    "docs/results.md": {
        f"at least {_DATA.min_instances} boxes": "code",
        f"at most {100 * (_DATA.max_target_area or 1):.0f} %": "code",
        "1,893 others": "size of the fit set, in the cards of the models",
        "9.9 seconds": "in milliseconds in the linked table",
    },
    "docs/tables.md": {
        f"({_OBJECTS[-1]} of {_DETECTIONS[-1]:,})": "counts in the file of the model",
        f"({_OBJECTS[0]} of {_DETECTIONS[0]:,})": "counts in the file of the model",
        "10,790 searches": "ten starts for each of the pairs in the table of photographs",
        "3,000 for each": "ten starts for each of 300 photographs",
        f"prior of {BeliefConfig().prior}": "code",
        "21 wrong places": "wrong places of the records of decide-nano, which were looked at one by one",
        "91.9 %": "with 15 of the 21 wrong places, 11.3 % become 8.1 %",
    },
    "docs/zoom.md": {
        f"confidence of {FAINT}": "code",
        f"candidates of {PhotographPlaces.least}": "code",
        f"window is {USUAL_WINDOW[0]} times as long": "code",
        f"within {_PHOTOGRAPH_BORDER:g} canvas px": "code",
        "up to 831 px on the longer side for an input of 416 px": "twice the input, less one",
        "2,048 pixels for each byte of its files, or 16.8 million": "code",
        "1.6 MB": "of a belief over the cells that the sentence counts",
        "0.41 MB": "upper bound by the size of the tensors",
        "134 MB": "of copies with at most 2 to the 25th pixels, three bytes each, and a third more",
        f"opset {OPSET}": "code",
    },
    "docs/head.md": {f"{1000 * _SPEEDS.eye_start:.0f} + {1000 * _SPEEDS.eye:.1f} A": "code", f"{_CONFIRM}": "code"},
    "docs/detectors.md": {
        f"({_DETECTOR.threshold}), ({_DETECTOR.iou}, over all classes), ({_DETECTOR.limit})": "code",
        f"{len(COCO_CLASSES)} scores": "code",
        "take 512 MiB and a pass 10 s": "code, tested with such models",
        "in [0, 1]": "a range",
        "shows with 0.9 is listed with 0.9": "a rule, tested with every head",
        "counts 1, a wrong place or a find in a photograph without the target -1, and no find 0": "a rule",
        "91 scores": "COCO's category ids with their gaps",
        "91 outputs": "torchvision's",
        "114 of 255": "the published networks' grey",
        "(640)": "code",
    },
    "docs/decisions/closer_looks.md": {
        f"shows {USUAL_WINDOW[0]} of the longer side": "code",
        f"{sum(each.numel() for each in _VERIFICATION.parameters())} parameters": "code",
        "21 wrong places": "wrong places of the records of decide-nano, which were looked at one by one",
    },
    "docs/measurements/head.md": {"the 300 of": "photographs of the results"},
    "docs/measurements/human.md": {"(612 searches of 10 people": "the files of the data set"},
    "docs/measurements/zoom.md": {"at score 0.1 and IoU 0.5": "what recall means"},
    "docs/sensors.md": {
        "δ (1 + r / a)": "a formula",
        f"has {_RINGS} rings of {_WEDGES} receptors, which is {_RINGS * _WEDGES:,} receptors for 307,200": "code",
    },
    "docs/pan-tilt.md": {"from -1 to 1": "a range", "(40 by default)": "code, tested with the agent"},
    "docs/testing.md": {f"longer than {MOST_LINES} lines": "code", "97.2 %": "coverage when it was last measured"},
    "docs/command.md": {
        f"from score {SCORE_THRESHOLD}": "code",
        f"at least {LIKELY} are": "code",
        "in 16 bits": "a type",
        "begin with 0": "a rule",
        "32 megapixels": "code",
    },
    "docs/guides/belief.md": {"sum to 1": "a rule", "equation 7": "docs/method.md"},
    "docs/guides/environments.md": {
        "is 0.05 in searches and 0.01 in explorations, and is 1": "signatures in the reference",
        "is 1 once": "a rule",
        "whole picture (0) to native pixels (1)": "a range",
        "score of 0.1 and overlaps": "what found means",
        f"score of {SCORE_THRESHOLD}, and an": "code",
    },
    "docs/guides/live.md": {
        f"at least {LIKELY} are listed": "code",
        f"{MOST_CLOSER} by default": "code",
        "for 15 s": "code, tested with a stream that breaks off",
        f"{log(2) / WINDOW_RATE:.1f} s by default": "code",
        f"rate, {FOVEA_RATE}, is {FOVEA_RATE * FRAME:g} a frame at {1 / FRAME:.0f} frames": "code",
        f"1/{1 / FRAME:.0f} s is taken": "code",
        "of 16 bits": "a type",
    },
    "docs/guides/records.md": {
        f"which is {SCORE_THRESHOLD} unless": "code",
        f"begin at {FAINTEST}": "code",
    },
    "docs/guides/robots.md": {"ROS 2": "a name", "version 4": "of vision_msgs"},
}
"""Numbers that no table has, each with the reason; those that are settings are written here by the code."""

_SMALL = "(?:one|two|three|four|five|six|seven|eight|nine|ten)"
IN_WORDS = re.compile(
    r"(?:more|less|fewer) than half\b"
    r"|\b(?:about|almost|nearly|only) (?:half|a third|a quarter|a fifth|a tenth|twice)\b"
    r"|\b(?:two thirds|three quarters|a third|a quarter|a fifth|a tenth) of\b"
    rf"|\b{_SMALL} (?:in|of|out of) {_SMALL}\b"
    rf"|\b{_SMALL} times as (?:many|much|long|fine|often|fast)\b",
    re.IGNORECASE,
)
"""Shares and ratios in words."""

SHARES = {
    "docs/zoom.md": {"more than half": "a rule"},
    "docs/tables.md": {
        "more than half of them were objects": (_OBJECTS[-1], _DETECTIONS[-1]),
        "one in ten at the fovea": (_OBJECTS[0], _DETECTIONS[0]),
    },
    "docs/detectors.md": {"One in five photographs is held out": "a rule", "one in three if there are fewer": "a rule"},
    "docs/results.md": {"windows of a third of the photograph": "a setting"},
    "docs/decisions/closer_looks.md": {"a third of the photograph": "a setting"},
    "docs/sensors.md": {
        "a fifth of the picture": ("142.3", 640),
        "almost nine times as fine": ("166.0", "19.0"),
        "a fifth of the pixels": (_RINGS * _WEDGES, 640 * 480),
        "almost twice as many objects": ("0.312", "0.159"),
    },
    "docs/pan-tilt.md": {"a tenth of its field of view": "a rule"},
    "docs/measurements/stream.md": {"a fifth of it": "a setting"},
    "docs/measurements/zoom.md": {
        "One of four boxes": ("0.250", 1),
        "less than half of themselves": "visibility in the annotations of the street",
        "less than a tenth of an object": "the border of low-yield cells in the code",
        "count for a tenth of it": "in the file of the model and its card",
    },
}
"""What shares and ratios in words are made of: the two numbers, in quotation marks if tables have them, or a reason."""

VALUES = {"half": 0.5, "third": 1 / 3, "quarter": 0.25, "quarters": 0.75, "fifth": 0.2, "tenth": 0.1, "twice": 2}


@cache
def text_of(page):
    return (ROOT / page).read_text(encoding="utf-8")


@cache
def paragraphs(page):
    """Paragraphs of a page that are no tables; in README a row of a table is one, with the heads of its columns."""
    text = re.sub(r"```.*?```|<!--.*?-->", "", text_of(page), flags=re.DOTALL)
    found = []
    for block in re.split(r"\n\s*\n", text):
        lines = [line for line in block.splitlines() if not line.startswith("#")]
        rows = [line for line in lines if line.startswith("|")]
        found += [f"{rows[0]}\n{row}" for row in rows[2:]] if page == "README.md" else []
        prose = "\n".join(line for line in lines if not line.startswith("|"))
        found += [item for item in re.split(r"\n(?=- )", prose) if item.strip()]
    return found


@dataclass(frozen=True)
class Cell:
    """A number of a table, with words that say what it is.

    Attributes:
        number: without its sign.
        row: words of its row.
        column: words of its column.
        only: words in the name of the table without which a sentence does not speak of it.
    """

    number: float
    row: frozenset[str]
    column: frozenset[str]
    only: frozenset[str]


@cache
def cells(page):
    """All numbers of the tables of a page."""
    found, head, rows, only = [], None, frozenset(), frozenset()
    for line in text_of(page).splitlines():
        if not line.startswith("|"):
            head = None
            if line.startswith("<!-- table "):
                only = words(line) & {"tiny", "narrow", "threshold", "hand"}
            elif line.startswith("<!-- end"):
                only = frozenset()
            continue
        parts = [part.strip() for part in line.strip().strip("|").split("|")]
        if head is None:
            head = [words(part) for part in parts]
            found += [Cell(abs(value(n)), frozenset(), frozenset(), only) for part in parts for n in numbers(part)]
            continue
        named = [part for part in parts if not NUMBER.match(part)]
        rows = words(" ".join(named)) if parts[0] else rows
        for column, part in zip(head, parts, strict=False):
            found += [Cell(abs(value(number)), rows, column, only) for number in numbers(part)]
    return found


STOP = frozenset(
    re.findall(r"\w+", "a an and are as at by each for from in is it its no not of on or than that the to with")
)

NUMERALS = ["zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten"]
ORDINALS = ["zeroth", "first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth"]
IN_DIGITS = {word: n for names in (NUMERALS, ORDINALS) for n, word in enumerate(names)} | {
    "twentieth": 20,
    "thirty": 30,
}

SAME = {
    "agent": "target evidence our learned",
    "semfov": "target evidence our",
    "closer": "target evidence",
    "box": "iou",
    "kl": "divergence",
    "divergence": "kl",
    "difference": "point",
    "without": "no",
    "hand": "non predictive raw tempering footprint box centre",
    "percentage": "share",
    "person": "people",
    "sooner": "later point difference",
    "map": "right",
}
"""Words of sentences, and words of tables that mean the same."""


def words(text):
    """Words of a text in their basic form, and its whole numbers, also those in letters."""
    plain = re.sub(r"\d+\.\d+|±", " ", text.lower())
    found = {word if word == "less" else word.removesuffix("s") for word in re.findall(r"[a-z]+|\d+", plain)} - STOP
    found |= {str(IN_DIGITS[word]) for word in found & IN_DIGITS.keys()}
    return frozenset(found.union(*(SAME[word].split() for word in found & SAME.keys())))


def numbers(text):
    return NUMBER.findall(text.replace("`", " ").replace("@", " "))


def value(number):
    return float(number.replace(",", "").replace("−", "-"))


def carried(number, known, said):
    """Whether a cell whose row and column are named has the number, rounded to as many digits or as a percentage."""
    digits = len(number.partition(".")[2])
    wanted = abs(value(number))
    reach = 0.5 * 10**-digits + 1e-9
    return any(
        abs(cell.number * scale - wanted) <= reach
        and cell.only <= said
        and 2 * len(cell.row & said) >= len(cell.row)
        and (not cell.column or cell.column & said)
        for cell in known
        for scale in ((1, 100) if cell.number <= 1 else (1,))
    )


def sentences(paragraph):
    return re.split(r"(?<=[.:?!])\s+(?=[A-Z*(`“-])", paragraph)


def sources(page, paragraph):
    """The pages whose tables may carry the numbers of a paragraph."""
    linked = [name for name, _ in LINK.findall(paragraph) if name]
    beside = [(ROOT / page).parent.joinpath(name).resolve() for name in linked]
    own = [] if page == "README.md" else [page]
    return [*own, *COMPANIONS.get(page, []), *(path.relative_to(ROOT).as_posix() for path in beside if path.exists())]


@cache
def with_command(page):
    """Paragraphs of the sections of a page that name a command."""
    sections = re.split(r"\n(?=#+ )", text_of(page))
    named = [" ".join(section.split()) for section in sections if COMMAND.search(section)]
    return [each for each in paragraphs(page) if any(" ".join(each.split()) in section for section in named)]


def numbers_without_a_table(page):
    """Sentences of a page with the numbers that no table carries."""
    found = []
    for paragraph in paragraphs(page):
        if page in OTHERS and paragraph in with_command(page):
            continue
        known = [cell for name in sources(page, paragraph) for cell in cells(name)]
        said = words(paragraph)
        for sentence in sentences(paragraph):
            plain = " ".join(HIDDEN.sub(" ", sentence).split())
            for phrase in KNOWN.get(page, {}):
                plain = plain.replace(phrase, " ")
            told = NUMBER.findall(CONDITIONS.sub(" ", plain))
            sure = [number for number in told if carried(number, known, said)]
            lost = [number for number in told if number not in sure and not is_difference(number, sure)]
            if lost:
                found.append((", ".join(lost), " ".join(sentence.split())))
    return found


def is_difference(number, others):
    """Whether a number is the difference of two others of its sentence."""
    gap = abs(value(number))
    return any(abs(abs(value(a) - value(b)) - gap) < 0.051 for a in others for b in others) and "." in number


@pytest.mark.parametrize("page", STRICT + OTHERS)
def test_every_number_of_a_sentence_is_in_a_table_or_has_a_reason(page):
    lost = numbers_without_a_table(page)
    told = "\n".join(f"  {numbers}: {sentence}" for numbers, sentence in lost)
    assert not lost, f"{page}: numbers that no table of the page or of a linked page has:\n{told}"


def in_words(text):
    """The value of a share or ratio in words, such as 0.9 of `nine in ten`."""
    said = text.lower().split()
    named = next((VALUES[word] for word in said if word in VALUES), None)
    counts = [IN_DIGITS[word] for word in said if word in NUMERALS]
    return named if named is not None else counts[0] / counts[1] if len(counts) == 2 else counts[0]


@pytest.mark.parametrize("page", STRICT + OTHERS)
def test_every_share_in_words_is_that_of_its_numbers_or_has_a_reason(page):
    plain = " ".join(" ".join(HIDDEN.sub(" ", paragraph).split()) for paragraph in paragraphs(page))
    listed = SHARES.get(page, {})
    assert [phrase for phrase in listed if phrase not in plain] == []
    for phrase, made_of in listed.items():
        if isinstance(made_of, str):
            continue
        tables = [text_of(name) for name in (page, *COMPANIONS.get(page, []))]
        told = [number for number in made_of if isinstance(number, str)]
        assert all(any(number in text for text in tables) for number in told), phrase
        share = float(made_of[0]) / float(made_of[1])
        assert share == pytest.approx(in_words(phrase), rel=0.15), phrase
    rest = plain
    for phrase in listed:
        rest = rest.replace(phrase, " ")
    assert IN_WORDS.findall(rest) == []


@pytest.mark.parametrize("page", KNOWN)
def test_every_number_with_a_reason_is_still_on_its_page(page):
    plain = " ".join(" ".join(HIDDEN.sub(" ", paragraph).split()) for paragraph in paragraphs(page))
    assert [phrase for phrase in KNOWN[page] if phrase not in plain] == []


def test_most_changes_of_a_number_are_noticed():
    """Of the decimals that tables carry, each changed by up to three units of its last digit."""
    changed = noticed = 0
    for page in STRICT:
        for paragraph in paragraphs(page):
            known = [cell for name in sources(page, paragraph) for cell in cells(name)]
            said = words(paragraph)
            plain = CONDITIONS.sub(" ", HIDDEN.sub(" ", paragraph))
            for number in NUMBER.findall(plain):
                if "." not in number or not carried(number, known, said):
                    continue
                digits = len(number.partition(".")[2])
                for step in (-3, -2, -1, 1, 2, 3):
                    other = f"{abs(value(number)) + step * 10**-digits:.{digits}f}"
                    changed += 1
                    noticed += not carried(other, known, said)
    assert changed > 100
    assert noticed / changed > 0.45, f"{noticed} of {changed}"
