"""Train a search agent with reinforcement learning: `python -m train.fit_agent` learns where to look from rewards.

    python -m train.fit_agent --out runs/fit_agent

The command needs `pip install "semfov[agents]"`. The agent acts in the environment `semfov/GazeSearch-v0` and observes
the belief alone: the probability of the target in every cell, the cells that it has fixated, and the position of its
gaze. A small convolutional network computes a logit for every cell. `sb3_contrib.MaskablePPO` trains it with a reward
of 1 for finding the target and a cost for every look. The agent has to learn by itself that probable cells are good.

Without photographs, the agent learns in embedded scenes and is evaluated in other embedded scenes. It is compared with
random gaze and with the hand-made policy whose belief it observes, from the same starting points. The folder `out` gets
the parameters (`agent.safetensors`) and a report.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.training.agent import FitAgentConfig, fit_agent


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(fit_agent, FitAgentConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
