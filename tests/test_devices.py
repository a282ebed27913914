"""Public functions and modules on a GPU, which is pretended on a machine without one: all but those that are named.

Modules are run by their testers. A function is run by the example in its docstring: its arguments are moved to the GPU,
its results are moved back, and the example must print what the docstring says. Small tensors need one thread.
"""

import copy
import doctest
import inspect
import multiprocessing
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import GeneratorType
from typing import Any

import pytest
import torch
from threadpoolctl import threadpool_info
from torch import Tensor, nn

import semfov
from docs.api import entries
from semfov import DirichletBelief, Grid, acquisition, foveate
from semfov.agents.episode import on_cpu
from semfov.belief import fuse
from semfov.belief.observers import Semantic
from semfov.data.fixations import Fixations
from semfov.detection.detections import Detections
from semfov.detection.scores import Candidates
from semfov.detection.selection import Selection, select
from semfov.episode import StoredLooks
from semfov.gaze.acquisition import Uniform
from semfov.gaze.choice import Given
from semfov.sensor import laplacian_pyramid
from semfov.sensor import pyramid as pyramids
from semfov.threads import _MANY_ELEMENTS, beside, one_thread, one_thread_if_small
from tests import small
from tests.pretended import a_gpu, waits
from tests.small import draw, model
from tests.test_modules import find_testers
from tests.viz.test_places import calls

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)

GEOMETRY = "holds the geometry of a scene, which is on the CPU; of a head, the eye alone is on the GPU (`HeadAgent`)"
LEFT_OUT = {
    "SearchGain": GEOMETRY,
    "ExploreGain": GEOMETRY,
    "PerSecond": GEOMETRY,
    "fit_discriminative": "needs gradients, for which PyTorch asks the GPU's driver",
    "AreaUnderRoc": "is moved by torchmetrics",
    "Reliability": "is moved by torchmetrics",
    "run": "takes files; its agent says where it looks",
}
"""Public modules and functions that are not run on the pretended GPU, and why."""

ON_CPU = {"merge_boxes", "open_scene"}
"""Functions whose results are on the CPU: of records and of scenes."""


def public(keep: Callable[[Any], bool]) -> dict[str, Any]:
    found = [each for things in entries().values() for each in things if keep(each[1])]
    assert len(dict(found)) == len(found), "two public names are equal"
    return dict(found)


MODULES = public(
    lambda thing: inspect.isclass(thing) and issubclass(thing, nn.Module) and not inspect.isabstract(thing)
)


def holds_tensors(kind: type) -> bool:
    """Whether an attribute of a class is annotated as a tensor."""
    hints = [hint for base in kind.__mro__ for hint in vars(base).get("__annotations__", {}).values()]
    return issubclass(kind, nn.Module) or any(re.search(r"\bTensor\b", str(hint)) for hint in hints)


HOLDERS = public(lambda thing: inspect.isclass(thing) and holds_tensors(thing))
TAKEN = re.compile(rf"\b(Tensor|ImageLike|{'|'.join(HOLDERS)})\b")


def takes_tensors(function: Any) -> bool:
    """Whether an argument of a function is annotated as a tensor, or as an object that holds one."""
    if not inspect.isfunction(function):
        return False
    return any(TAKEN.search(str(hint)) for name, hint in function.__annotations__.items() if name != "return")


FUNCTIONS = public(takes_tensors)


@contextmanager
def copies_on(device: torch.device) -> Iterator[list[Tensor]]:
    """While it is open, deep copies have their tensors on a device; yields the tensors that were copied."""
    copied: list[Tensor] = []

    def copied_tensor(self: Tensor, memo: dict[int, Any]) -> Tensor:
        if id(self) not in memo:
            copied.append(self)
            there = self.detach().to(device)
            parameter = isinstance(self, nn.Parameter)
            memo[id(self)] = nn.Parameter(there, self.requires_grad) if parameter else there
        return memo[id(self)]

    with pytest.MonkeyPatch.context() as patch:
        for kind in (Tensor, nn.Parameter):
            patch.setattr(kind, "__deepcopy__", copied_tensor)
        yield copied


class OnGpu:
    """A function whose arguments are moved to the GPU, and whose results are moved back.

    Attributes:
        given: the tensors among the arguments.
        results: the tensors among the results.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function, self.inside = function, False
        self.given: list[Tensor] = []
        self.results: list[Tensor] = []

    def __call__(self, *args: Any, **options: Any) -> Any:
        if self.inside:
            return self.function(*args, **options)
        with copies_on(GPU) as copied:
            args, options = copy.deepcopy((args, options))
        self.given += copied
        self.inside = True
        try:
            result = self.function(*args, **options)
            if isinstance(result, GeneratorType):
                result = iter([*result])
        finally:
            self.inside = False
        with copies_on(CPU) as copied:
            result = copy.deepcopy(result)
        self.results += copied
        return result


def more(folder: Path) -> dict[str, tuple[tuple[Any, ...], dict[str, Any]]]:
    """Arguments and options of functions that have no example with tensors that runs."""
    path = small.scanpath(small.GRID, torch.tensor([0, 6, 11]), target=2)
    looks = StoredLooks(small.scattered(0, small.GRID, 2), small.GRID)
    episode = looks, Semantic(3), Uniform(), torch.tensor([4]), Given(torch.tensor([[0, 7, 9]]))
    person = Fixations("a.jpg", "1", path.fixations.numpy(), (64, 48))
    image = small.rand(3, 48, 64)
    viewed = [Fixations(f"{number}", "1", small.rand(9, 2).numpy() * 40, (64, 48)) for number in range(5)]
    densities = {record.picture: small.rand(6, 8) for record in viewed}
    return {name: (arguments, options) for name, (arguments, options, _) in calls(path).items()} | {
        "content_suspicions": ((viewed, densities, dict.fromkeys(densities, (64, 48))), {}),
        "animate": ((path, folder / "film.gif"), {"image": image, "views": [image] * 3}),
        "as_image": ((image,), {}),
        "compare_scanpath": ((path, [person, person]), {}),
        "merge_boxes": ((torch.tensor([[4.0, 4, 9, 9]]), torch.rand(1), torch.ones(1, dtype=torch.long)), {}),
        "rollout": (episode, {"most": 3}),
    }


def run(name: str, folder: Path) -> OnGpu:
    """Run a function on the GPU: with the arguments of `more`, or else by its example."""
    function = FUNCTIONS[name]
    on_gpu, given = OnGpu(function), more(folder).get(name)
    if given is not None:
        arguments, options = given
        with a_gpu():
            on_gpu(*arguments, **options)
        return on_gpu
    (example,) = doctest.DocTestFinder(recurse=False).find(
        function, name=name, globs=dict(vars(sys.modules[function.__module__]))
    )
    failures: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        for module in [module for key, module in sys.modules.items() if key.startswith("semfov")]:
            for key in [key for key, value in vars(module).items() if value is function]:
                patch.setattr(module, key, on_gpu)
        example.globs[function.__name__] = on_gpu
        with a_gpu():
            doctest.DocTestRunner(verbose=False).run(example, out=failures.append)
    assert not failures, "".join(failures)
    return on_gpu


def test_every_module_runs_on_a_gpu_or_is_named():
    ran = {name for name, tester in find_testers().items() if tester.test_device is not None}
    assert {name for name in MODULES if f"Test{name}" not in ran} == LEFT_OUT.keys() & MODULES.keys()


@pytest.mark.parametrize("name", sorted(FUNCTIONS.keys() - LEFT_OUT.keys()))
def test_a_function_runs_on_a_gpu(name, tmp_path):
    on_gpu = run(name, tmp_path)
    assert on_gpu.given
    assert {tensor.device.type for tensor in on_gpu.results} <= {"cpu" if name in ON_CPU else "cuda"}


def test_the_page_on_testing_names_what_does_not_run_on_a_gpu():
    page = (Path(__file__).parents[1] / "docs/testing.md").read_text(encoding="utf-8")
    assert LEFT_OUT.keys() <= MODULES.keys() | FUNCTIONS.keys()
    rows = "\n".join(f"| `{name}` | {reason} |" for name, reason in LEFT_OUT.items())
    assert f"|---|\n{rows}\n\n" in page, f"docs/testing.md must have the table\n{rows}"


def on_gpu(*shape: int) -> Tensor:
    return small.rand(*shape).to(GPU)


def foveated(count: int) -> object:
    return semfov.foveate(on_gpu(1, 3, 16, 16), on_gpu(1, count, 2), sigma=3.0)


def fused(count: int) -> object:
    return semfov.belief.fuse(1 + on_gpu(count, 4, 3), on_gpu(count, 2, 3), on_gpu(count, 2, 4) < 0.5)


def explored(count: int) -> object:
    model = small.model().to(GPU)
    value = semfov.acquisition.KLDivergence(model, semfov.Grid(2, 2, (16, 16))).to(GPU)
    belief = semfov.DirichletBelief(1 + on_gpu(count, 4, len(model.classes) + 1))
    return value(belief, torch.zeros(count, 4, dtype=torch.bool, device=GPU))


def selected(count: int) -> Detections:
    low = 8 * on_gpu(count, 20, 2)
    candidates = Candidates(torch.cat([low, low + 4], -1), on_gpu(count, 20, 3))
    return select(candidates, None, Selection(threshold=0.5), "residual")


def test_an_episode_believes_on_the_cpu_what_an_eye_on_the_gpu_sees():
    agent, image = small.agent(small.Coloured()), small.rand(3, 120, 160)
    here = agent.search(image, "green", how="fovea", shifts=3)
    with torch.no_grad(), a_gpu():
        there = agent.to(GPU).search(image, "green", how="fovea", shifts=3)
    assert there.probabilities.device == CPU
    torch.testing.assert_close(there.cells, here.cells)
    torch.testing.assert_close(there.probabilities, here.probabilities, rtol=1e-3, atol=1e-4)


def test_a_copy_on_the_cpu_is_as_its_module_is_now():
    with torch.no_grad(), a_gpu():
        part = nn.BatchNorm1d(2)
        module = nn.Sequential(part, nn.Linear(2, 2), part).to(GPU)
        module.eval().note = "changed"
        module[1].weight.data.fill_(3.0)
        with waits() as found:
            here = on_cpu(module)
        assert len(found) <= len({each.dtype for each in module.state_dict().values()})
        assert {each.device for each in here.state_dict().values()} == {CPU}
        assert here[0] is here[2]
        assert here[0] is not part
        assert (here.training, here.note, here[1].weight.tolist()) == (False, "changed", [[3.0, 3.0]] * 2)
        assert module[1].weight.device == GPU
        torch.testing.assert_close(here(torch.ones(1, 2)), module(torch.ones(1, 2, device=GPU)).cpu())


@pytest.mark.parametrize("work", [foveated, fused, explored, selected])
def test_more_episodes_do_not_wait_for_the_gpu_more_often(work):
    """Nor do more fixations: they are computed together, and few values are read."""
    often = []
    with torch.no_grad(), a_gpu():
        work(2)  # makes what is kept for further calls
        for count in (2, 9):
            with waits() as found:
                work(count)
            often.append(found)
    assert often[0] == often[1]


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


def test_a_thread_beside_the_main_one_leaves_the_number_for_others(threads):
    """A third thread, which starts meanwhile, would keep the number of one."""

    def meanwhile(work):
        (thread := threading.Thread(target=work)).start()
        thread.join()

    counts = []

    def count():
        counts.append(torch.get_num_threads())

    def spare():
        with one_thread():
            count()
            meanwhile(count)

    meanwhile(spare)
    assert counts == [threads] * 2
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


def test_products_beside_a_block_take_one_thread_where_pytorch_has_one():
    """PyTorch tells a new thread its number when it is asked there; before that, products run on all cores."""
    counts = []

    def work() -> None:
        of_products = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "openmp"]
        counts.extend(of_products)

    with one_thread(), beside(work, idle=True):
        pass
    assert counts
    assert set(counts) == {1}
