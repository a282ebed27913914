"""Random generators seeded by their purpose, such as one episode of one protocol."""

import hashlib

import torch
from torch import Tensor

from semfov.runs.config import ProtocolConfig


def generator_for(*purpose: object) -> torch.Generator:
    """Make a generator seeded by its purpose, so that the numbers of one episode do not depend on another.

    Args:
        purpose: what the numbers are for, such as an episode.

    Returns:
        The generator.
    """
    digest = hashlib.sha256(repr(purpose).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)


def noise_for(protocol: ProtocolConfig, cells: int, *episode: object) -> Tensor:
    """Sample random numbers that break the ties of an episode.

    Args:
        protocol: the protocol of the run.
        cells: number of cells.
        episode: scene, target (None: exploration) and repetition.

    Returns:
        `(shifts+1, X·Y)`, a number for each cell at each look.
    """
    purpose = ("exploration" if part is None else part for part in episode)
    shape = protocol.shifts + 1, cells
    if protocol.ties == "first":
        # Of cells of the same value the one with the largest number is taken: here the first one.
        return torch.linspace(1, 0, cells).expand(shape)
    return torch.rand(shape, generator=generator_for("ties", protocol.seed, *purpose))
