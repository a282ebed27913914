"""Labelled detections of all photographs, shard by shard, on the processors of a command."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.samples import Sampler, Samples
from semfov.runs.workers import run_tasks


def _run_shard(sampler: Sampler, shard: int) -> bytes:
    return pack_tensors(vars(sampler.sample(shard)))


def collect_samples(config: Any, folder: Path, title: str, kind: type[Sampler] = Sampler) -> Sampler:
    """Collect the labelled detections of all photographs; only those of shards that are not finished are computed.

    The result is the same to the last bit wherever the work is done, on processors of one kind.
    """
    sampler = kind(config, folder)
    todo = [shard for shard in sampler.shards if sampler.load(shard) is None]
    done = run_tasks(
        _run_shard,
        todo,
        where=config.where,
        make=kind,
        settings=(config, folder),
        title=title,
        unit="shard",
    )
    with closing(done):
        for shard, tensors in done:
            sampler.save(shard, Samples(**unpack_tensors(tensors)))
    return sampler
