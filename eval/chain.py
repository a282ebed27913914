"""The paper's chain step by step: `python -m eval.chain` compares it as shipped, set by hand, and learned in folds.

    python -m eval.chain --data.root DIR --data.annotations instances.json --out runs/chain

The detector looks at every photograph from every cell; `eval.search` shares these looks under the same `--cache`. The
photographs are dealt into folds. An observation model is fitted through the belief of searches in the other folds
(`semfov.fit.through_belief`), and searches those of its own. The table has the targets found after some gaze shifts,
and the difference to the learned chain, photograph by photograph. The model that is fitted on all photographs is
saved in `out`. If the command is stopped, repeat it to continue.

With `--belief.search_model` nothing is fitted, and this model searches all photographs; with `--data.ids` they may be
those that it was not fitted on.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from eval.comparison.summary import announce, by_scene, collect_records, write_summary
from eval.search.report import found
from eval.search.run import SearchConfig, SearchRun
from semfov.errors import InputError
from semfov.fit.samples import AnnotatedLooks, annotated_looks
from semfov.fit.through_belief import fit_through_belief
from semfov.io.files import write_text
from semfov.io.ranges import Count, Range
from semfov.metrics.episodes import FloatArray, standard_error
from semfov.observation.foveal import FovealObservationModel
from semfov.runs.command import command
from semfov.runs.config import PolicyConfig, RunConfig
from semfov.runs.looking import Looking
from semfov.runs.presets import AGENT
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import finish
from semfov.runs.setup import make_observation
from semfov.runs.tables import plus_minus, table

_STEPS: dict[str, str | PolicyConfig] = {
    "as shipped": "non-predictive-calibrated",
    "set by hand": PolicyConfig(
        "non-predictive", tempering=0.25, footprint="box_centre", memory="closest", misses=True
    ),
    "learned": AGENT,
}
"""Policies by their names in the table."""

_LEARNED = "learned"
_SHIFTS = (1, 5, 10, 15, 30)


@dataclass(frozen=True)
class ChainConfig(RunConfig):
    """Search photographs by the paper's chain: as shipped, set by hand, and learned in folds.

    Args:
        folds: number of groups into which the photographs are dealt.
        steps: number of steps of each fit.
        looks: most looks in a search of the fits.
        out: folder for the table, the records and the model that is fitted on all photographs.
    """

    unused = ("policies",)
    folds: Annotated[int, Range(2, 1000)] = 2
    steps: Count = 150
    looks: Count = 10
    out: Path = Path("runs/chain")


class _Folds:
    """Photographs in folds, the searches that they allow, and a model to fit through them.

    Attributes:
        config: the settings.
        ids: id of each photograph.
        searches: looks at the photographs with a class to search for.
        start: the observation model that the fits start from.
    """

    def __init__(self, config: ChainConfig) -> None:
        self.config = config
        run = Looking(config)
        if len(run.scenes) < 2 * config.folds:
            raise InputError(f"data: expected at least 2 photographs in each fold, got {len(run.scenes)} in all")
        finish(run, "looking")
        self.ids = [*run.scenes.ids]
        photographs = range(len(run.scenes))
        looks = ((index, run.detections(index), run.grid(index).centres) for index in photographs)
        annotated = annotated_looks(run.scenes, looks, run.cells, config.data.max_target_area)
        self.searches: list[AnnotatedLooks] = [searched for searched in annotated if len(searched.targets)]
        self.start = make_observation(config.belief.model, run.eye)

    def fit(self, left_out: int | None) -> FovealObservationModel:
        """Fit a model to the photographs of all folds but one; None leaves none out."""
        config = self.config
        chosen = [searched for searched in self.searches if searched.photograph % config.folds != left_out]
        record = {"looks": config.looks, "steps": config.steps, "photographs": len(chosen)}
        return fit_through_belief(self.start, chosen, looks=config.looks, steps=config.steps, search=record)

    def search(self, fold: int, model: Path) -> list[ResultRecord]:
        """Search the photographs of a fold by all policies; the learned chain has the model of a file."""
        config = self.config
        ids = config.out / f"fold-{fold}.txt"
        write_text(ids, "".join(f"{name}\n" for name in self.ids[fold :: config.folds]))
        belief = replace(config.belief, search_model=str(model))
        data = replace(config.data, ids=ids, limit=None)
        records = search_by_steps(replace(config, data=data, belief=belief, out=config.out / f"fold-{fold}"))
        return [{**record, "fold": fold} for record in records]


_COMMON = ("data", "belief", "out", "detector", "cache", "workers", "scheduler", "sensor", "store", "protocol")
"""Settings of searches."""


def search_by_steps(config: ChainConfig) -> list[ResultRecord]:
    """Search photographs by all policies; the learned chain has the model of `belief.search_model`."""
    run = SearchRun(SearchConfig(**{name: getattr(config, name) for name in _COMMON}, policies=tuple(_STEPS.values())))
    finish(run, "searching")
    names = dict(zip(run.policies, _STEPS, strict=True))
    records, _ = collect_records(run)
    return [{**record, "policy": names[record["policy"]]} for record in records]


def chain_summary(records: Sequence[ResultRecord], shifts: int, model: str | None = None) -> str:
    """Write the table, as Markdown: the targets found by each policy, and the differences to the learned chain.

    Args:
        records: the searches.
        shifts: largest number of gaze shifts.
        model: the model of the learned chain; None for those that were fitted on the other folds.

    Returns:
        The caption and the table.
    """
    at = [number for number in _SHIFTS if number <= shifts]
    curves = {name: _by_photograph(records, name, shifts) for name in _STEPS}
    rows = [["policy", *(f"CP@{number}" for number in at)]]
    for name, curve in curves.items():
        rows.append([name, *_cells(curve, at)])
    for name, curve in curves.items():
        if name != _LEARNED:
            rows.append([f"{name} - {_LEARNED}", *_cells(curve - curves[_LEARNED], at, sign="+")])
    photographs, searches = len(curves[_LEARNED]), sum(record["policy"] == _LEARNED for record in records)
    learned = "the model that was fitted on the other folds" if model is None else f"`{model}`"
    return "\n".join(
        [
            f"Targets found within n gaze shifts (%), ± standard error over {photographs} photographs; {searches} "
            f"searches by each policy. *learned*: by {learned}.",
            "",
            *table(rows),
            "",
        ]
    )


def _by_photograph(records: Sequence[ResultRecord], policy: str, shifts: int) -> FloatArray:
    """Compute the share of targets found after 0, 1, … shifts in each photograph, `(photographs, shifts + 1)`."""
    pairs = ((record["scene"], found(record, shifts)) for record in records if record["policy"] == policy)
    return np.stack([*by_scene(pairs).values()])


def _cells(curve: FloatArray, at: Sequence[int], sign: str = "") -> list[str]:
    """Write the means after some shifts in percent, with their standard errors over the photographs."""
    mean = 100 * curve.mean(0)
    error = 100 * standard_error(curve)
    return [plus_minus(float(mean[number]), float(error[number]), sign=sign) for number in at]


def compare_chains(config: ChainConfig) -> None:
    """Fit and search in folds, or search by a given model; write the table, the records and what was fitted."""
    given = config.belief.search_model
    records = _fit_and_search(config) if given is None else search_by_steps(config)
    text = chain_summary(records, config.protocol.shifts, given)
    announce(text, write_summary(config.out, "chain", text, records))


def _fit_and_search(config: ChainConfig) -> list[ResultRecord]:
    """Fit and search in folds; saves the models of the folds, and the one that is fitted on all photographs."""
    folds = _Folds(config)
    records: list[ResultRecord] = []
    for fold in range(config.folds):
        model = config.out / f"fold-{fold}.safetensors"
        folds.fit(fold).save(model)
        records += folds.search(fold, model)
    folds.fit(None).save(config.out / "search.safetensors")
    return records


main = command(compare_chains, ChainConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
