"""Training an agent in the search environment by Stable-Baselines3's PPO, and judging it on other scenes."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np

from semfov.errors import check
from semfov.experiments.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    ProtocolConfig,
    SearchConfig,
    SensorConfig,
)
from semfov.experiments.settings import Count, Positive, Range, Seed, Settings, Share, Shifts, Side, Weight
from semfov.experiments.setup import check_sources, prepare_worker
from semfov.experiments.summary import table
from semfov.io import storage
from semfov.io.files import inside
from semfov.metrics.averages import standard_error
from semfov.metrics.search import cumulative_performance
from semfov.training.outputs import write_outputs

if TYPE_CHECKING:
    from semfov.envs.agents import Agent, Ran
    from semfov.envs.scenery import Scenery

_AT = (1, 3, 5, 10)
"""Gaze shifts after which searches are counted."""


@dataclass(frozen=True)
class FitAgentConfig(Settings):
    """Train an agent that searches, by masked PPO on the belief of the environment.

    Args:
        data: scenes to learn from; none of them given, 48 embedded ones.
        judged: scenes to judge by; none of them given, 24 embedded ones by another seed.
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        policy: preset of `eval.search` whose belief the agent sees, and that it is compared with.
        columns: cells in a row.
        rows: cells in a column.
        shifts: most gaze shifts of an episode.
        price: of a look, where the find is worth 1.
        environments: episodes side by side.
        steps: gaze shifts to learn from, of all environments together.
        horizon: gaze shifts of each environment between two updates.
        epochs: passes over them in an update.
        minibatch: gaze shifts of a gradient.
        rate: of learning.
        discount: of a reward one gaze shift later.
        width: channels of the network.
        starts: of each judged scene and target.
        seed: of parameters, episodes and draws.
        cache: folder for what the detector sees from every cell (None: the user's cache).
        out: folder for the parameters and the report.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(limit=48, min_instances=0))
    judged: DataConfig = field(default_factory=lambda: DataConfig(limit=24, min_instances=0, scene_seed=1000))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    policy: str = "recommended"
    columns: Side = 10
    rows: Side = 10
    shifts: Shifts = 30
    price: Weight = 0.05
    environments: Annotated[int, Range(1, 10_000)] = 64
    steps: Count = 100_000
    horizon: Count = 32
    epochs: Count = 4
    minibatch: Count = 512
    rate: Positive = 1e-3
    discount: Share = 0.95
    width: Annotated[int, Range(1, 1024)] = 16
    starts: Annotated[int, Range(1, 10_000)] = 10
    seed: Seed = 0
    cache: Path | None = None
    out: Path = Path("runs/fit_agent")

    def scenery(self, data: DataConfig, starts: int) -> Scenery:
        """The world with these scenes."""
        from semfov.envs import open_scenery

        config = SearchConfig(
            data=data,
            detector=self.detector,
            sensor=self.sensor,
            belief=BeliefConfig(columns=self.columns, rows=self.rows),
            protocol=ProtocolConfig(starts, self.shifts, seed=self.seed),
            policies=(self.policy,),
            cache=self.cache,
        )
        return open_scenery("search", config=config)


def fit_agent(config: FitAgentConfig) -> None:
    """Train, judge beside random gaze and the hand-made policy, and write everything."""
    from semfov.envs import GazeVectorEnv, MaskedRandom, PolicyAgent, run_agent

    for data in (config.data, config.judged):
        check_sources(data, config.detector)
    check(config.data != config.judged, "judged", "other scenes than those to learn from", "the same")
    prepare_worker()
    learned_from, judged = config.scenery(config.data, 100), config.scenery(config.judged, config.starts)
    model, returns = train(config, learned_from)
    envs = GazeVectorEnv("search", 64, judged, price=config.price, belief=True, autoreset_mode="Disabled")
    agents: dict[str, Agent] = {
        "random": MaskedRandom(config.seed),
        "hand-made": PolicyAgent(envs),
        "trained": TrainedAgent(model),
    }
    episodes = [episode for scene in judged.scenes for episode in judged.episodes(scene)]
    ran = {name: run_agent(envs, agent, episodes) for name, agent in agents.items()}
    scenes = np.array([episode.scene for episode in episodes])
    figures = {name: summary(each, scenes, config) for name, each in ran.items()}
    path = inside(config.out, "agent.safetensors")
    # What the policy calls by two names is kept once.
    tensors = {name: each for name, each in model.policy.state_dict().items() if not name.startswith("features")}
    storage.write(path, tensors, {"kind": "semfov-agent", "policy": config.policy, "width": config.width})
    found = {name: [each.found_at for each in rows] for name, rows in ran.items()}
    text = report(config, figures, len(learned_from.scenes), len(judged.scenes), len(episodes), model)
    write_outputs(config, text, ("judged.json", json.dumps({"found_at": found, "returns": returns}) + "\n"), path)


def train(config: FitAgentConfig, scenery: Scenery) -> tuple[Any, list[float]]:
    """The trained model, and the mean return of the episodes that ended before each update."""
    from semfov.envs import GazeVectorEnv
    from semfov.envs.stable_baselines3 import StableVecEnv  # before those that it tells the lack of
    from semfov.training.agent_network import CellPolicy, MaskablePPO, Returns

    together = GazeVectorEnv(
        "search", config.environments, scenery, price=config.price, belief=True, detections=False,
        autoreset_mode="SameStep",
    )  # fmt: skip
    envs = StableVecEnv(together, key="belief")
    envs.seed(config.seed)
    model = MaskablePPO(
        CellPolicy,
        envs,
        learning_rate=config.rate,
        n_steps=config.horizon,
        batch_size=min(config.minibatch, config.horizon * config.environments),
        n_epochs=config.epochs,
        gamma=config.discount,
        seed=config.seed,
        policy_kwargs={"width": config.width},
        device="cpu",
    )
    told = Returns()
    model.learn(config.steps, callback=told)
    return model, told.means


class TrainedAgent:
    """A model of Stable-Baselines3 as an agent that takes its most probable action.

    Args:
        model: that was trained on the belief alone.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def __call__(self, observations: Any, infos: dict[str, Any]) -> Any:
        """The next cell of every episode."""
        masks = infos["action_mask"].astype(bool)
        # Of an episode that is over all cells may have been fixated.
        masks |= ~masks.any(-1, keepdims=True)
        return self._model.predict(observations["belief"], action_masks=masks, deterministic=True)[0]


def summary(ran: list[Ran], scenes: Any, config: FitAgentConfig) -> dict[str, tuple[float, float]]:
    """Figures of merit, each with its standard error over scenes."""
    found = np.array([each.found_at for each in ran])
    spent = np.array([len(each.cells) - 1 for each in ran])
    measures = {f"CP@{n}": 100 * cumulative_performance(found[:, None], n)[:, -1] for n in _AT if n <= config.shifts}
    measures |= {"gaze shifts": spent.astype(float), "return": (found >= 0) - config.price * spent}
    figures = {}
    for name, values in measures.items():
        means = np.array([values[scenes == scene].mean() for scene in np.unique(scenes)])
        figures[name] = float(means.mean()), float(standard_error(means))
    return figures


def report(
    config: FitAgentConfig,
    figures: dict[str, dict[str, tuple[float, float]]],
    learned_from: int,
    judged: int,
    episodes: int,
    model: Any,
) -> str:
    """The table as Markdown."""
    names = list(next(iter(figures.values())))
    rows = [["agent", *names]]
    for agent, found in figures.items():
        rows.append([agent, *(f"{mean:.2f} ± {error:.2f}" for mean, error in found.values())])
    parameters = sum(each.numel() for each in model.policy.parameters())
    return "\n".join(
        [
            f"An agent of {parameters:,} parameters, trained by masked PPO over {model.num_timesteps:,} gaze shifts in "
            f"{learned_from} scenes on the belief of `{config.policy}`, judged in {episodes} searches of {judged} "
            "other scenes. CP@n is the percentage found after n gaze shifts; standard errors are over scenes. The same "
            "starts for all.",
            "",
            *table(rows),
            "",
        ]
    )
