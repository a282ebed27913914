"""Train an agent that searches: `python -m train.fit_agent` learns where to look by trial, with others' PPO.

    python -m train.fit_agent --out runs/fit_agent

It needs `pip install "semfov[agents]"`. The agent acts in `semfov/GazeSearch-v0` and sees the belief alone: the
probability of the target in every cell, which cells it has fixated, and where its gaze is. A small convolutional
network gives every cell a number, and `sb3_contrib.MaskablePPO` learns it from rewards: 1 for the find, minus the price
of every look. Nothing tells it that a probable cell is a good one.

Without photographs it learns in embedded scenes and is judged in embedded scenes by another seed, beside random gaze
and the hand-made policy whose belief it sees, from the same starts. The folder `out` gets the parameters
(`agent.safetensors`) and a report.
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
