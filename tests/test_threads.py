"""Small tensors are worked on by one thread, and the number of threads is the same afterwards."""

import multiprocessing
import threading

import pytest
import torch

from semfov import DirichletBelief, Grid, acquisition, foveate
from semfov.belief import fuse
from semfov.sensor import laplacian_pyramid
from semfov.sensor import pyramid as pyramids
from semfov.threads import _MANY_ELEMENTS, beside, one_thread_if_small
from tests.small import draw, model


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield 3
    torch.set_num_threads(before)


@one_thread_if_small
def used(*values):
    return torch.get_num_threads()


def test_only_small_tensors_are_worked_on_by_one_thread(threads):
    small, large = torch.zeros(_MANY_ELEMENTS - 1), torch.zeros(_MANY_ELEMENTS)
    bands = pyramids.Bands((large,), small, "kornia")
    assert [used(), used(small), used((small,), 1.0)] == [1, 1, 1]
    assert [used(large), used(small, large), used((small, (large,))), used(bands)] == [threads] * 4
    assert torch.get_num_threads() == threads


def test_an_error_restores_the_threads(threads):
    @one_thread_if_small
    def fails(value):
        raise ValueError(value)

    with pytest.raises(ValueError, match="7"):
        fails(7)
    assert torch.get_num_threads() == threads


@pytest.mark.parametrize("name", ["foveate", "laplacian_pyramid", "fuse", "KL divergence"])
def test_hot_paths_use_one_thread(threads, name, monkeypatch):
    """Seen from an operation inside."""
    counts = set()

    class Watch(torch.overrides.TorchFunctionMode):
        def __torch_function__(self, func, types, args=(), kwargs=None):
            counts.add(torch.get_num_threads())
            return func(*args, **(kwargs or {}))

    image, grid = torch.rand(1, 3, 64, 64), Grid(4, 3, (64, 48))
    beta = 1 + draw(1, 12, 4, dtype=torch.float32).abs()
    value = acquisition.KLDivergence(model(), grid)
    runs = {
        "foveate": lambda: foveate(image, (3.0, 4.0), sigma=9.0),
        "laplacian_pyramid": lambda: laplacian_pyramid(image, 3),
        "fuse": lambda: fuse(beta, torch.full((1, 2, 4), 0.5), torch.ones(1, 2, 12, dtype=torch.bool)),
        "KL divergence": lambda: value(DirichletBelief(beta, torch.ones(1, 12)), torch.zeros(1, 12, dtype=torch.bool)),
    }
    with Watch():
        runs[name]()
    assert 1 in counts
    assert counts <= {1, threads}
    assert torch.get_num_threads() == threads


def test_work_is_done_beside_a_block_where_a_core_is_left(monkeypatch):
    """What fails in it is left out, and none is done without a core, or in a process that shares its cores."""
    names = []

    def work() -> None:
        names.append(threading.current_thread().name)
        raise ValueError

    for cores, idle, parent, done in ((1, False, None, 0), (8, False, None, 1), (1, True, None, 1), (8, True, 1, 0)):
        names.clear()
        monkeypatch.setattr("semfov.threads.available_cores", lambda cores=cores: cores)
        monkeypatch.setattr(multiprocessing, "parent_process", lambda parent=parent: parent)
        monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
        with beside(work, idle=idle):
            pass
        assert len(names) == done
        assert threading.current_thread().name not in names
