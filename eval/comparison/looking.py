"""Looks and policies that are compared in scenes, with the saliency that they need of each scene."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch
from torch import Tensor

from eval.comparison.saliency import SaliencyStore, saliency_map, saliency_table
from eval.comparison.settings import ComparedConfig
from semfov.belief.grid import Grid
from semfov.errors import lookup
from semfov.gaze.acquisition import AcquisitionFunction, SaliencyPrior, Static
from semfov.runs.config import SaliencyModel
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.scene_run import store_folder
from semfov.strategy import Strategy


class Candidate(Strategy):
    """A policy under comparison, in one scene; saliency `(X·Y, X·Y)` from every cell, or `(1, X·Y)` from anywhere."""

    def __init__(self, strategy: Strategy, saliency: Tensor | None = None, weight: float = 1.0) -> None:
        super().__init__(strategy.observer, strategy.policy)
        self.strategy = strategy
        self.saliency = saliency
        self.weight = weight

    def acquisition(self, target: int | Tensor | None, grid: Grid, cell: Tensor) -> AcquisitionFunction:
        """Return the acquisition function of episodes that fixate `cell` `(B,)`."""
        if self.saliency is None:
            return super().acquisition(target, grid, cell)
        salient = self.saliency[cell if len(self.saliency) > 1 else torch.zeros_like(cell)]
        if self.policy.function is Static:
            return Static(salient)
        return SaliencyPrior(self.policy(target, grid), salient, weight=self.weight)


class ComparedLooking(PolicyLooking):
    """Looks at scenes, and policies that are compared in them, with the saliency that they need of each scene."""

    config: ComparedConfig

    def __init__(self, config: ComparedConfig) -> None:
        super().__init__(config)
        folder = store_folder(config.cache) / "saliency"
        eye = self.eye.settings()
        how = config.saliency
        self.saliency_stores = {
            name: SaliencyStore(folder, name, how.view, how.reduction, eye["sensor"], config.cells, eye["detector"])
            for name in dict.fromkeys(policy.saliency for policy in self.policies.values())
            if name is not None
        }

    def depends_on(self) -> dict[str, Any]:
        """List what looks and policies depend on, and the settings of saliency."""
        return {**super().depends_on(), "saliency": asdict(self.config.saliency) if self.saliency_stores else None}

    def candidate(self, name: str, index: int) -> Candidate:
        """Return the policy of this name in tables, for a scene."""
        policy = self.policies[lookup(name, self.policies, "policy of this run")]
        saliency = None if policy.saliency is None else self.saliency(policy.saliency, index)
        return Candidate(self.strategies[name], saliency, self.config.saliency.weight)

    def saliency(self, name: SaliencyModel, index: int) -> Tensor:
        """Saliency of the cells of a scene (`saliency_table`), read from the store, or computed and stored."""
        digest = self.digest(index)
        store = self.saliency_stores[name]
        saliency = store.load(digest) if self.config.store else None
        if saliency is None:
            image = self.scenes[index].image
            how = self.config.saliency
            seen = self.eye.sensor, self.config.sensor.reference, image, self.grid(index)
            saliency = saliency_table(saliency_map(name, self.eye.detector), how.view, how.reduction, *seen)
            if self.config.store:
                store.save(digest, saliency)
        return saliency
