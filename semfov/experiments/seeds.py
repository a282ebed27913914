"""Random numbers that depend on what they are for, and on nothing else."""

import hashlib

import torch
from torch import Tensor

from semfov.experiments.config import ProtocolConfig


def generator_for(*what: object) -> torch.Generator:
    """A generator seeded by what it is for, so that no episode's numbers depend on another's."""
    digest = hashlib.sha256(repr(what).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)


def noise_for(protocol: ProtocolConfig, cells: int, *episode: object) -> Tensor:
    """Random numbers that break the ties of the episode that `episode` names, `(shifts+1, X·Y)`."""
    shape = protocol.shifts + 1, cells
    if protocol.ties == "first":
        return torch.linspace(1, 0, cells).expand(shape)
    return torch.rand(shape, generator=generator_for("ties", protocol.seed, *episode))
