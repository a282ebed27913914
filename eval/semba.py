"""The searcher of SemBA, with Kaplan's rule and with the rule in its code: `python -m eval.semba`.

    python -m eval.semba --data.root val --data.annotations instances_val.json

A search starts in the middle of the photograph, looks through a multi-scale fovea, fuses raw scores on a grid of
32 × 20 cells, fixates the most probable cell that was not fixated before, and ends after six gaze shifts or where the
target has a probability of 0.1 in the fixated cell (Luzio, Bernardino and Moreno, 2026; the code of SemBA,
vislab-tecnico-lisboa/SemBA). To continue a stopped run, give the same command again.
"""

import sys
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from semfov.belief.observers import Semantic
from semfov.episode import Step, rollout
from semfov.errors import DataError
from semfov.gaze.acquisition import TargetPosterior
from semfov.gaze.choice import Greedy, drawn_from
from semfov.io.files import write_text
from semfov.runs.command import command
from semfov.runs.config import BeliefConfig, DetectorConfig, LookingConfig, ProtocolConfig, SensorConfig
from semfov.runs.looking import CellLooks, Looking
from semfov.runs.looks import photograph_looks
from semfov.runs.progress import track
from semfov.runs.seeds import noise_for
from semfov.runs.settings import Share
from semfov.runs.store import RememberedLooks
from semfov.runs.tables import percent, table

_RULES = ("kaplan", "semba")
_SHIFTS = (1, 3, 6)


@dataclass(frozen=True)
class _SembaConfig(LookingConfig):
    """Search as SemBA does, with both rules of fusion.

    Args:
        belief: the belief; `columns`, `rows` and `prior` are used.
        protocol: the protocol; `shifts`, `ties` and `seed` are used.
        stop: probability of the target in the fixated cell at which a search ends.
        out: folder for the table.
        workers: ignored; the photographs are searched in this process.
        scheduler: ignored.
    """

    detector: DetectorConfig = field(default_factory=lambda: DetectorConfig(background="none", threshold=0.01))
    sensor: SensorConfig = field(default_factory=lambda: SensorConfig("multi-scale"))
    belief: BeliefConfig = field(default_factory=lambda: BeliefConfig(columns=32, rows=20, prior=1.0))
    protocol: ProtocolConfig = field(default_factory=lambda: ProtocolConfig(shifts=6))
    stop: Share = 0.1
    out: Path = Path("runs/semba")


def _search_as_semba(config: _SembaConfig) -> None:
    """Search for every target of every photograph with both rules, and write the table."""
    run = Looking(config)
    results: list[Tensor] = []
    scenes: list[int] = []
    for index in track(range(len(run.scenes)), "searching", "scene"):
        outcomes = _search_scene(config, run, index)
        results += outcomes
        scenes += [index] * len(outcomes)
    if not results:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    figures = torch.stack(results)  # (searches, rules, figures)

    def measure(cases: Tensor) -> Tensor:
        chosen = figures[cases]
        stopped, right = chosen[..., -2].mean(0), chosen[..., -1].sum(0) / chosen[..., -2].sum(0)
        return torch.cat([chosen[..., :-2].mean(0), torch.stack([stopped, right], -1)], -1)

    bootstrap = Bootstrap.of(measure, scenes)
    head = ["rule", *(f"CP@{n}" for n in _SHIFTS), "stopped", "right of those"]
    rows = [
        [rule, *(percent(float(v), float(e)) for v, e in zip(bootstrap.value[n], bootstrap.error[n], strict=True))]
        for n, rule in enumerate(_RULES)
    ]
    text = "\n".join([f"{len(results)} searches in {len(set(scenes))} photographs", "", *table([head, *rows]), ""])
    write_text(config.out / "summary.md", text)
    print(text)


@torch.inference_mode()
def _search_scene(config: _SembaConfig, run: Looking, index: int) -> list[Tensor]:
    """Search one photograph for each of its targets that is not in the middle."""
    grid, annotation = run.grid(index), run.scenes.annotation(index)
    middle = grid.cell_of(grid.extent[None] / 2)
    covered = grid.footprint(annotation.boxes)
    goals = {target: covered[annotation.labels == target].any(0) for target in run.scenes.targets(index)}
    targets = torch.tensor([target for target, goal in goals.items() if not bool(goal[middle])], dtype=torch.int64)
    if not len(targets):
        return []
    goal = torch.stack([goals[target] for target in targets.tolist()])
    image = run.scenes[index].image[None]
    store = run.store if config.store else None
    remembered = RememberedLooks(
        lambda: photograph_looks(run.eye, lambda: image, grid), store, lambda: run.digest(index)
    )
    shifts = config.protocol.shifts
    noise = torch.stack([noise_for(config.protocol, len(grid), index, target) for target in targets.tolist()])
    results = []
    for rule in _RULES:
        observer = Semantic(len(run.scenes.classes) + 1, prior=config.belief.prior, fusion=rule)

        def sure(step: Step) -> Tensor:
            probability = step.belief.probability(targets[step.episodes])
            return probability.gather(-1, step.cell[:, None])[:, 0] >= config.stop

        fixated = torch.zeros(len(targets), shifts + 1, dtype=torch.bool)
        stopped = torch.zeros(len(targets), 2, dtype=torch.bool)
        steps = rollout(
            CellLooks(remembered, grid, image),
            observer,
            lambda episodes, cell: TargetPosterior(targets[episodes]),
            middle.expand(len(targets)),
            Greedy(drawn_from(noise)),
            most=shifts + 1,
            ends=sure,
        )
        for step in steps:
            on = goal[step.episodes, step.cell]
            fixated[step.episodes, step.shift :] |= on[:, None]
            ended = sure(step)
            stopped[step.episodes[ended], 0] = True
            stopped[step.episodes[ended], 1] = on[ended]
        results.append(torch.cat([fixated[:, [n for n in _SHIFTS if n <= shifts]], stopped], -1).float())
    remembered.save()
    return list(torch.stack(results, 1))


main = command(_search_as_semba, _SembaConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
