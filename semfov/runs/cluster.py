"""The workers of a Dask cluster as an executor."""

from collections.abc import Iterator
from concurrent.futures import CancelledError, Executor
from contextlib import contextmanager
from logging import getLogger

from semfov.errors import InputError, SemfovError

_REACH = 10.0
"""Seconds in which a scheduler must answer."""

_RETURN = 300.0
"""Seconds in which a scheduler that was lost must be there again."""

_log = getLogger(__name__)


class ClusterLost(Exception):
    """The connection to the scheduler broke, and with it the tasks that it had."""


@contextmanager
def open_cluster(address: str, *, again: bool = False) -> Iterator[Executor]:
    """Connect to a Dask scheduler, and give tasks to its workers.

    Dask gives the tasks of a worker that dies to another one. Slurm, Kubernetes and others start such workers by
    `dask-jobqueue` and `dask-kubernetes`.
    """
    try:
        from distributed import Client, KilledWorker
        from distributed.comm.core import CommClosedError
    except ModuleNotFoundError:
        raise InputError("scheduler: needs Dask; pip install 'semfov[cluster]'") from None
    try:
        client = Client(address, timeout=_RETURN if again else _REACH, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"scheduler: expected the address of a running Dask scheduler, such as tcp://host:8786, got {address!r} "
            f"({type(error).__name__}); start one with `dask scheduler`"
        ) from None
    with client:
        if not client.scheduler_info()["workers"]:
            _log.warning("the scheduler at %s has no worker yet; start some with `dask worker %s`", address, address)
        executor = client.get_executor(pure=False)
        try:
            yield executor
        except (CancelledError, CommClosedError):
            raise ClusterLost("the connection to the scheduler broke") from None
        except KilledWorker as error:
            raise SemfovError(
                f"scheduler: a task ended several workers (out of memory?): {error}; give the workers more memory"
            ) from None
        finally:
            executor.shutdown(wait=False)
