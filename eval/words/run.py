"""Does context help search? Compares searches with and without context, from the same starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np

from eval.comparison.summary import Curve, announce, collect_records, curve_of, sensing, write_files
from eval.search.report import found
from eval.search.run import SearchConfig, SearchRun
from semfov.belief import ContextPrior
from semfov.belief.look_features import highest_score
from semfov.errors import DataError, check
from semfov.io.files import clean, inside
from semfov.runs.config import ContextKind, LookingConfig, PolicyConfig, ProtocolConfig
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import finish
from semfov.runs.settings import Seed, Share, Weight
from semfov.runs.tables import table

_SHIFTS = (1, 3, 5, 10, 30)
"""Gaze shifts at which the table gives the share of targets found."""


@dataclass(frozen=True)
class WordsConfig(LookingConfig):
    """Search without context, with context counted from annotations, and with context from tables, each with a control.

    Args:
        protocol: the protocol of the experiment.
        policy: the policy to which context is added: `target-evidence`, or a mapping such as `{policy: non-predictive,
            tempering: 0.25, footprint: box_centre}`.
        context: which context is added: `place`, `cooccurrence` or `both`.
        counted: context counted from annotations, by name or file; it serves as the upper reference.
        tables: contexts from tables, files of `train.fit_context --table`.
        weights: weights of place and co-occurrence in all arms (null: the weights fitted with each context).
        permuted: random seed of the control, in which the classes of each table are permuted.
        missed: the first look counts as missing the target if the target's highest score in it is below this.
        out: folder for tables, per-episode records and the manifest.
    """

    protocol: ProtocolConfig = field(default_factory=ProtocolConfig)
    policy: str | PolicyConfig = "target-evidence"
    context: ContextKind = "both"
    counted: str = "coco"
    tables: tuple[Path, ...] = ()
    weights: tuple[Weight, Weight] | None = None
    permuted: Seed = 0
    missed: Share = 0.1
    out: Path = Path("runs/words")


class WordsRun(SearchRun):
    """Searches that also record the target's highest score in the first look."""

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Run all searches of a scene; each record also holds the target's highest score in the first look."""
        records, seconds = super().outcomes(index)
        if records:
            scores = highest_score(self.detections(index), slice(None))  # type: ignore[arg-type]
            for record in records:
                record["first_score"] = round(float(scores[record["start"], record["target"]]), 6)
        return records, seconds


def words(config: WordsConfig) -> None:
    """Run all arms, and write and print their results and differences."""
    check(config.context != "none", "context", "place, cooccurrence or both", config.context)
    arms = arms_of(config)
    settings = {each.name: getattr(config, each.name) for each in fields(LookingConfig)}
    run = WordsRun(SearchConfig(**settings, protocol=config.protocol, policies=tuple(arms.values()), scanpaths=0))
    finish(run, "searching")
    records, seconds = collect_records(run)
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    named = dict(zip(run.policies, arms, strict=True))
    for record in records:
        record["arm"] = named[record.pop("policy")]
    text = "\n".join([f"{sensing(run)}, context: {config.context}", "", *outcome_tables(records, list(arms), config)])
    announce(text, write_files(run, "eval.words", {"words.md": text}, records, seconds, config))


def arms_of(config: WordsConfig) -> dict[str, PolicyConfig]:
    """The policies under comparison by their names in the table; changed contexts are written to the folder `out`."""
    base = PolicyConfig(config.policy) if isinstance(config.policy, str) else config.policy
    counted = ContextPrior.from_pretrained(config.counted)
    arms = {"none": base, "counted": _with(base, config, config.counted if config.weights is None else counted)}
    for path in config.tables:
        name = clean(path.stem)
        check(name not in arms, "tables", "files of different names", name)
        prior = ContextPrior.from_pretrained(path)
        arms[name] = _with(base, config, str(path) if config.weights is None else prior)
        arms[f"{name}, permuted"] = _with(base, config, prior.permuted(config.permuted))
    return arms


def _with(base: PolicyConfig, config: WordsConfig, context: str | ContextPrior) -> PolicyConfig:
    """Add a context to the policy; a context without a file is first written to the folder `out`."""
    if isinstance(context, ContextPrior):
        if config.weights is not None:
            context.weights = dict.fromkeys(context.weights, config.weights)
        # The name depends on the content, so that results with another context are never reused.
        path = inside(config.out, f"context-{context.digest()[:16]}.safetensors")
        if not path.exists():
            context.save(path)
        context = str(path)
    return replace(base, context=config.context, context_model=context)


def outcome_tables(records: Sequence[ResultRecord], arms: Sequence[str], config: WordsConfig) -> list[str]:
    """Tables of all searches, and of the searches whose first look misses the target, as lines of Markdown."""
    missed = [record for record in records if record["first_score"] < config.missed]
    lines = []
    for title, group in (("All searches", records), ("Searches whose first look misses the target", missed)):
        if not group:
            lines += [f"{title}: none.", ""]
            continue
        shifts = [n for n in _SHIFTS if n <= config.protocol.shifts]
        rows = [["context", *(f"CP@{n}" for n in shifts), *(f"gain @{n}" for n in shifts)]]
        images = 0
        for arm in arms:
            plain_curve = curve_of((r for r in group if r["arm"] == arm), lambda r: found(r, config.protocol.shifts))
            images = plain_curve.images
            row = [arm, *(f"{100 * plain_curve.mean[n]:.1f}" for n in shifts)]
            if arm == "none":
                row += [""] * len(shifts)
            else:
                paired = differences(group, arm, config.protocol.shifts)
                row += [signed(paired.mean[n], paired.over_images[n]) for n in shifts]
            rows.append(row)
        searches = len(group) // len(arms)
        lines += [
            f"{title} ({images} images, {searches} searches per arm; percentage of targets found after n gaze shifts, "
            "mean over images; paired differences of the same searches, ± standard error over images)",
            "",
            *table(rows),
            "",
        ]
    return lines


def differences(records: Sequence[ResultRecord], arm: str, shifts: int) -> Curve:
    """Share found with an arm minus share found without context, paired by search (`curve_of`)."""
    without = {_search(record): record for record in records if record["arm"] == "none"}
    chosen = [record for record in records if record["arm"] == arm]
    return curve_of(chosen, lambda record: found(record, shifts) - found(without[_search(record)], shifts))


def _search(record: ResultRecord) -> tuple[object, ...]:
    return record["scene"], record["target"], record["repetition"]


def signed(value: float, error: float) -> str:
    """A difference of shares and its standard error in percentage points, such as `+1.2 ± 0.4`."""
    return f"{100 * value:+.1f}" + (f" ± {100 * error:.1f}" if np.isfinite(error) else "")
