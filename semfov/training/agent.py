"""Train an agent in the search environment with Stable-Baselines3's PPO, and evaluate it on other scenes."""

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
from semfov.experiments.tables import table
from semfov.io import storage
from semfov.io.files import inside
from semfov.metrics.averages import standard_error
from semfov.metrics.search import cumulative_performance
from semfov.training.outputs import write_outputs

if TYPE_CHECKING:
    from semfov.envs.agents import Agent, Ran
    from semfov.envs.scenery import Scenery

_AT = (1, 3, 5, 10)
"""Numbers of gaze shifts after which the share of successful searches is reported."""


@dataclass(frozen=True)
class FitAgentConfig(Settings):
    """Train a search agent with masked PPO, with the belief of the environment as its observation.

    Args:
        data: scenes to learn from (by default 48 embedded scenes).
        judged: scenes to evaluate on (by default 24 embedded scenes with another seed).
        detector: the detector that processes the foveated views.
        sensor: the foveal sensor.
        policy: preset of `eval.search`. The agent sees the belief of this preset and is compared with its policy.
        columns: columns of the grid.
        rows: rows of the grid.
        shifts: maximum number of gaze shifts in an episode.
        price: cost of each look, relative to the reward of 1 for finding the target.
        environments: number of episodes that run in parallel.
        steps: total number of gaze shifts to learn from, over all environments.
        horizon: gaze shifts of each environment between two updates.
        epochs: passes over the collected gaze shifts in each update.
        minibatch: gaze shifts in one gradient step.
        rate: learning rate.
        discount: discount factor of rewards per gaze shift.
        width: channels of the network's hidden layers.
        starts: starting points for each evaluated scene and target.
        seed: seed of the initial parameters, the episodes and all random draws.
        cache: folder for the detections from every cell (None: the user's cache).
        out: folder for the trained parameters and the report.
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
        """Open the environment's scenery for some scenes.

        Args:
            data: the scenes.
            starts: starting points for each scene and target.

        Returns:
            The scenery, with the detections from every cell computed.
        """
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
    """Train the agent, compare it with random gaze and the hand-made policy, and write all results."""
    from semfov.envs import GazeVectorEnv, MaskedRandom, PolicyAgent, run_agent

    for data in (config.data, config.judged):
        check_sources(data, config.detector)
    check(config.data != config.judged, "judged", "scenes other than those of `data`", "the same scenes")
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
    # The policy lists its feature extractors under two names; one copy is enough.
    tensors = {name: each for name, each in model.policy.state_dict().items() if not name.startswith("features")}
    storage.write(path, tensors, {"kind": "semfov-agent", "policy": config.policy, "width": config.width})
    found = {name: [each.found_at for each in rows] for name, rows in ran.items()}
    text = report(config, figures, len(learned_from.scenes), len(judged.scenes), len(episodes), model)
    write_outputs(config, text, ("judged.json", json.dumps({"found_at": found, "returns": returns}) + "\n"), path)


def train(config: FitAgentConfig, scenery: Scenery) -> tuple[Any, list[float]]:
    """Train a network with masked PPO.

    Args:
        config: the settings.
        scenery: the scenes to learn from.

    Returns:
        The trained model, and for each update the mean return of the last episodes that ended before it.
    """
    from semfov.envs import GazeVectorEnv
    from semfov.envs.stable_baselines3 import StableVecEnv  # first, as its error names the missing package
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
    recorder = Returns()
    model.learn(config.steps, callback=recorder)
    return model, recorder.means


class TrainedAgent:
    """Wrap a Stable-Baselines3 model as an agent that takes the most probable action.

    Args:
        model: a model that was trained on the belief alone.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def __call__(self, observations: Any, infos: dict[str, Any]) -> Any:
        """Choose the next cell of every episode."""
        masks = infos["action_mask"].astype(bool)
        # When an episode is over, all of its cells may have been fixated, but the model needs one allowed action.
        masks |= ~masks.any(-1, keepdims=True)
        return self._model.predict(observations["belief"], action_masks=masks, deterministic=True)[0]


def summary(ran: list[Ran], scenes: Any, config: FitAgentConfig) -> dict[str, tuple[float, float]]:
    """Compute performance measures of an agent, each with its standard error over scenes.

    Args:
        ran: the finished episodes.
        scenes: the scene of each episode, `(E,)`.
        config: the settings.

    Returns:
        For each measure its mean over scenes and the standard error of that mean.
    """
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
    """Write the comparison of the agents as Markdown."""
    names = list(next(iter(figures.values())))
    rows = [["agent", *names]]
    for agent, found in figures.items():
        rows.append([agent, *(f"{mean:.2f} ± {error:.2f}" for mean, error in found.values())])
    parameters = sum(each.numel() for each in model.policy.parameters())
    return "\n".join(
        [
            f"An agent with {parameters:,} parameters was trained with masked PPO over {model.num_timesteps:,} gaze "
            f"shifts in {learned_from} scenes. It sees the belief of `{config.policy}`. All agents are evaluated in "
            f"the same {episodes} searches in {judged} other scenes, from the same starting points. CP@n is the "
            "percentage of targets found after n gaze shifts. Standard errors are over scenes.",
            "",
            *table(rows),
            "",
        ]
    )
