"""How many objects an exploration of a large picture says there are, and how many were annotated."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from semfov.agents.windows import NEW_OBJECTS
from semfov.data.scene import Annotation
from semfov.detection.objects import LEAST
from semfov.runs.results import ResultRecord
from semfov.runs.tables import table
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glances
from semfov.zoom.objects import merge
from semfov.zoom.search import find_everything

SHOWN, EXPECTED = f"objects from score {LEAST:g}", "expected number"
"""Names of the two numbers of a record: that of its `objects`, and that of `expected`."""


def count_objects(
    glances: Glances, evidence: GlimpseEvidence, target: int | None, annotation: Annotation, *, passes: int
) -> list[ResultRecord]:
    """Find all objects of a picture, and count them.

    Args:
        glances: the looks at the picture.
        evidence: learned evidence by magnification.
        target: class whose objects are counted, 1..K; None for all classes.
        annotation: the annotated objects of the class.
        passes: largest number of passes of the detector.

    Returns:
        A record for each number. There is no expected number without a fitted certainty.
    """
    turns = islice(find_everything(glances, evidence, target, worth=NEW_OBJECTS), passes)
    objects = merge([turn.glance for turn in turns], target)
    numbers = {SHOWN: float(len(objects.above(LEAST)))}
    if evidence.certainty is not None:
        numbers[EXPECTED] = float(evidence.certainty.probability(objects.scores).sum())
    true = len(annotation.boxes) - int(annotation.crowd.sum())
    return [{"measure": "number", "way": way, "number": number, "objects": true} for way, number in numbers.items()]


def number_table(records: Sequence[ResultRecord], passes: int) -> list[str]:
    """Table of the errors of each number, as Markdown."""
    rows = [["", "mean", "mean absolute error", "mean error"]]
    for way in dict.fromkeys(record["way"] for record in records):
        group = [record for record in records if record["way"] == way]
        errors = [record["number"] - record["objects"] for record in group]
        mean, off = sum(record["number"] for record in group), sum(map(abs, errors))
        rows.append([way, *(f"{each / len(group):.2f}" for each in (mean, off)), f"{sum(errors) / len(group):+.2f}"])
    pictures = len({record["scene"] for record in records})
    objects = sum(record["objects"] for record in records) / max(len(records), 1)
    return [
        f"Number of objects of a picture after at most {passes} passes of the detector; {pictures} pictures with "
        f"{objects:.1f} objects in the mean.",
        "",
        *table(rows),
        "",
    ]
