"""Random generators seeded by their purpose, such as one episode of one protocol."""

import hashlib

import torch
from torch import Tensor

from semfov.runs.config import ProtocolConfig


def generator_for(*what: object) -> torch.Generator:
    """A generator seeded by its purpose `what`, so that the numbers of one episode do not depend on another."""
    digest = hashlib.sha256(repr(what).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "big") >> 1)


def noise_for(protocol: ProtocolConfig, cells: int, *episode: object) -> Tensor:
    """Random numbers `(shifts+1, X·Y)` for the ties of an `episode`: scene, target (None: exploration), repetition."""
    what = ("exploration" if each is None else each for each in episode)
    shape = protocol.shifts + 1, cells
    if protocol.ties == "first":
        return torch.linspace(1, 0, cells).expand(shape)
    return torch.rand(shape, generator=generator_for("ties", protocol.seed, *what))
