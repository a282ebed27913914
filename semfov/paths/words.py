"""The words for a record: what was found, why the episode ended, and what its numbers mean."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from typing import ClassVar

from semfov.data.classes import counted
from semfov.decision import Decision
from semfov.detection.objects import box_text
from semfov.paths.outcome import Outcome

_MATTERS = 0.1  # change of the probability, at one half, from which on the assumed share is said
_PROBABLE = 2 / 3  # from which on a target that no place shows for sure is called probably there
_CLEAR = 0.5  # probability or score from which on a place was clearly seen as the target


def number_with_error(mean: float, error: float) -> str:
    """Write an expected number and its standard deviation, such as `45 ± 9` or `0.8 ± 1.9`."""
    # Whole numbers would hide a small error, and read as `expect 1 cups`.
    places = 0 if error >= 1 and max(mean, error) >= 10 else 1
    return f"{mean:.{places}f} ± {error:.{places}f}"


class Words(ABC):
    """Words for a record; each kind of record has its own (`Record.words`).

    Args:
        record: the record.

    Example::

        words = agent.find_all("harbour.tif", "person").words
        print(words.objects, words.threshold, words.why_it_ended())
    """

    _sentences: ClassVar[Mapping[str, str]] = {
        "box": "The gaze is on a box of the target.",
        "detection": "A detection shows the target at the gaze.",
        "min_gain": "No look is expected to classify enough more cells correctly.",
        "cells": "Every cell was fixated.",
        "duration": "The next look would end after the time limit of the scene.",
        "seconds": "The time was over.",
        "stopped": "It was stopped.",
        "found": "The target is probable enough, and was looked at closely enough.",
        "absent": "No remaining cell is worth a look.",
        "undecided": "No remaining cell is worth a look, but the target is too probable to call it absent.",
        "closer found": "A closer look confirmed the target.",
        "closer undecided": "The target is too probable to call it absent.",
    }
    """Why it ended, by the ending, or by the outcome of the decision that ended the search."""

    _pictures: ClassVar[str] = "pictures"
    """What is searched, in the plural."""

    def __init__(self, record: Outcome) -> None:
        self.record = record

    @abstractmethod
    def describe(self) -> str:
        """Describe the outcome in one line."""

    @property
    def lines(self) -> list[str]:
        """Lines about the looks, for the printed record."""
        return []

    @property
    def task(self) -> str:
        """What was asked, in a few words, such as `search for “cup”`."""
        record = self.record
        if not record.sought:
            return "what is where"
        names = ", ".join(f"“{record.classes[label]}”" for label in record.sought)
        return f"all objects: {names}" if record.targets else f"search for {names}"

    @property
    def measure(self) -> str:
        """What the scores of objects are: `probability` with a fitted certainty, otherwise `score`."""
        return "score" if self.record.unseen is None else "probability"

    @property
    def threshold(self) -> str:
        """The threshold of listed objects, such as `probability 0.5`."""
        return f"{self.measure} {self.record.score_threshold:g}"

    @property
    def decided_by(self) -> str:
        """Kind of the decision's number: `probability`, `belief` (without thresholds), or the best `score`."""
        return "probability"

    @property
    def value(self) -> str:
        """What the value of a look means, for which it was chosen."""
        return "the value of the acquisition function at its cell"

    @property
    def sensor(self) -> str | None:
        """The sensor or the windows, in words; None if they are not known."""
        return None

    @property
    def objects(self) -> str:
        """Number of the objects, by class where classes were searched for, such as `2 cups, no cat found`."""
        record = self.record
        labels = record.objects.labels
        counts = [counted(int((labels == label).sum()), record.classes[label]) for label in record.sought]
        text = f"{', '.join(counts) or counted(len(labels), 'object')} found"
        return text[0].upper() + text[1:]

    @property
    def classes(self) -> str:
        """Number of the objects by class, the most frequent first, with the number of each to expect in all."""
        counts = Counter(self.record.objects.labels.tolist()).most_common()
        return ", ".join(
            f"{counted(count, self.record.classes[label])}{self._number_in_all(label)}" for label, count in counts
        )

    def _number_in_all(self, label: int) -> str:
        """Say how many objects of a class to expect, in brackets; empty where it is not known."""
        return ""

    def verdict(self, name: str, colon: str = "") -> str:
        """Say what was decided, such as `cup probably absent`, or `no cup clearly seen: undecided`.

        A common target may have a high probability although no look shows one; the words say so first.

        Args:
            name: the target, as it is written.
            colon: the text between the name and the decision.

        Returns:
            A few words.
        """
        verdict = self.record.verdict
        if verdict == "undecided" and not self._is_seen_clearly:
            return f"no {name} clearly seen: undecided"
        return f"{name}{colon} {self.doubt}{verdict}"

    @property
    def doubt(self) -> str:
        """The word `probably ` for a target that is absent, but not surely; otherwise empty."""
        record = self.record
        return "probably " if record.verdict == "absent" and record.is_doubtful else ""

    @property
    def _is_seen_clearly(self) -> bool:
        """Whether a candidate or a closer look has at least one half for the target."""
        record = self.record
        chances = [look.place for look in record.closer]
        chances += record.candidates.of(record.sought).scores.tolist()
        return max(chances, default=0.0) >= _CLEAR

    @property
    def best_place(self) -> str:
        """The most likely place of a target that was not found, in words; empty if there is none."""
        place = self.record.best_place
        if place is None:
            return ""
        box, number = place
        measure = "probability" if self.record.closer else self.measure
        return f"best place: box {box_text(box.tolist())}, {measure} {number:.2f}"

    def why_it_ended(self) -> str:
        """Explain in one sentence why the search or the exploration ended.

        Returns:
            The sentence; empty if the reason is not known.
        """
        record = self.record
        if record.closer and record.found:
            return self._why_found_closely()
        if record.ending == "decision" and record.decision is not None:
            return self._why_decided(record.decision)
        if record.ending == "shifts":
            return f"All {len(record.fixated) - 1} gaze shifts were made."
        if record.ending == "passes":
            return f"All {record.passes} passes were used." if record.passes != 1 else "The only pass was used."
        return self._sentences.get(record.ending or "", "")

    def _why_decided(self, decision: Decision) -> str:
        """Say on what evidence the search decided: closer looks have sentences of their own in some kinds of look."""
        # Look 0 shows the whole picture; a search that looked at it alone has looked at nothing closer.
        looked_closer = any(look.index != 0 for look in self.record.closer)
        name = f"closer {decision.outcome}" if looked_closer else decision.outcome
        return self._sentences.get(name, self._sentences[decision.outcome])

    def _why_found_closely(self) -> str:
        """Say that a closer look found the target; with windows as large as the picture the first look is one."""
        decision = self.record.decision
        sentence = self._sentences["closer found"]
        if decision is None or decision.box is None:
            return sentence
        indices = [look.index for look in self.record.closer if look.box.equal(decision.box)]
        return self._sentences.get("first found", sentence) if indices == [0] else sentence

    def assumption(self) -> str:
        """Say which share of pictures with the target the probability assumes, and what it would be with one half.

        The sentence is empty unless it matters: the target was not found, and with one half the probability would be at
        least 0.1 higher or lower.

        Returns:
            The sentence; empty also if the assumed share is not known.
        """
        record = self.record
        decision = record.decision
        if decision is None or decision.outcome == "found" or record.assumed is None:
            return ""
        at_half = record.probability_at(0.5)
        if abs(at_half - decision.probability) < _MATTERS:
            return ""
        # Never 100 %, to which three digits would round: an assumed share is below 1.
        share = f"{min(100 * record.assumed, 99.9):.3g} % of your {self._pictures} hold it"
        return f"This assumes that {share}; if half of them did, it would be {at_half:.2f} after these looks."

    def lack(self) -> str:
        """Say what an undecided search lacked for `found`: a place that is probable enough.

        Returns:
            The sentence; empty for other decisions, and if it is not known what `found` requires.
        """
        record = self.record
        decision = record.decision
        if decision is None or decision.outcome != "undecided" or decision.confirm is None:
            return ""
        if self.decided_by != "probability":
            return f"To call it found takes {self.decided_by} {decision.confirm:.3g}, and a look that shows it."
        is_likely = "is probably" if decision.probability >= _PROBABLE else "may be"
        reached = f"none reached probability {decision.confirm:.3g} ({len(record.closer)} looked at closely)"
        if not record.closer:
            reached = f"to call it found takes probability {decision.confirm:.3g}, and a look that shows it"
        return f"It {is_likely} there, but no place is sure: {reached}."

    @property
    def ended(self) -> str:
        """Why the episode ended, and what an undecided search lacked; empty if neither is known."""
        return " ".join(filter(None, [self.why_it_ended(), self.lack()]))

    @property
    def remarks(self) -> list[str]:
        """Sentences about doubts: what the search lacked, where the target is most likely, and what is assumed."""
        place = self.best_place.capitalize()
        sentences = [self.lack(), f"{place}." if place else "", self.assumption()]
        return [sentence for sentence in sentences if sentence]

    def summary(self) -> str:
        """Describe the outcome, explain why the episode ended, and say what is in doubt.

        Returns:
            The sentences.
        """
        return " ".join([self.describe() + self._ending, *self.remarks])

    @property
    def _ending(self) -> str:
        """End of the summary's first sentence, and why it ended."""
        return f". {self.why_it_ended()}".rstrip()


class MomentWords(Words):
    """Words for one frame of a stream."""

    _pictures = "frames"

    @property
    def decision(self) -> str | None:
        """The decision in a few words; None without one."""
        decision = self.record.decision
        if decision is None:
            return None
        place = "" if decision.place is None else f" (there {decision.place:.2f})"
        return f"{self.record.target_name}: {decision.outcome}, p {decision.probability:.2f}{place}"
