"""Labelled detections of all photographs, shard by shard, on the processors of a command."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.samples import Sampler, Samples
from semfov.runs.setup import prepare_worker
from semfov.runs.workers import run_tasks

_process: dict[str, Sampler] = {}


def _prepare(kind: type[Sampler], config: Any, folder: Path) -> None:
    prepare_worker()
    _process["sampler"] = kind(config, folder)


def _run_shard(shard: int) -> bytes:
    return pack_tensors(vars(_process["sampler"].sample(shard)))


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
        setup=_prepare,
        settings=(kind, config, folder),
        title=title,
        unit="shard",
    )
    with closing(done):
        for shard, tensors in done:
            sampler.save(shard, Samples(**unpack_tensors(tensors)))
    return sampler
