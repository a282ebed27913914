"""Fixtures of all tests: devices, photographs, other processes, and a hypothesis profile without deadlines."""

import atexit
import gc
import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Generator, Iterator
from contextlib import ExitStack, nullcontext
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from hypothesis import HealthCheck, settings

from tests.pretended import a_gpu

pytest.register_assert_rewrite("tests.base_tester")
# Each run draws the same examples: half as many as by default take half the time.
settings.register_profile(
    "semfov", max_examples=50, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("semfov")


# What is imported and collected stays to the end: to look through it for garbage again and again takes long.
gc.disable()
atexit.register(gc.unfreeze)


def pytest_collection_finish() -> None:
    """From here on look for garbage among what the tests make."""
    gc.freeze()
    gc.enable()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option by which printed texts are taken for the right ones (`tests.golden`)."""
    parser.addoption("--accept", action="store_true", help="write what is printed into tests/golden")


@pytest.fixture
def accept(request: pytest.FixtureRequest) -> bool:
    """Tell whether printed texts are taken for the right ones."""
    return bool(request.config.getoption("--accept"))


def pytest_configure() -> None:
    """Give each worker and the processes that it starts one thread, as all workers share the cores."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        os.environ.setdefault("OMP_NUM_THREADS", "1")
        torch.set_num_threads(1)


RUNS = {"finished", "fitted", "home", "trained", "whole"}
"""Fixtures that run a command to its end."""
LAB = {"lab", "eval"}
"""Folders of tests of the laboratory: studies, the fits that only studies need, benchmarks."""
OF_LAB = re.compile(rf"mark\.lab|def (?:{'|'.join(RUNS)})\(")
"""What the file of a test of the laboratory contains that lies in another folder."""
NO_CALL = SimpleNamespace(params={})


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files whose tests would all be deselected, with the laboratory or without: to read them takes long."""
    asked, folder = config.option.markexpr, collection_path.parent.relative_to(config.rootpath).parts[1:2]
    if collection_path.suffix != ".py" or not asked.startswith(("lab", "not lab")):
        return None
    if asked.startswith("not"):
        return True if LAB & {*folder} else None
    if {*LAB, "site"} & {*folder} or OF_LAB.search(collection_path.read_text(encoding="utf-8")):
        return None
    return True


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests of the laboratory and of the built site, and as slow and of the laboratory those of a whole run.

    These use a fixture that runs a command to its end.

    A test of both precisions and both devices uses the GPU in single precision alone.
    """
    here = Path(__file__).parent
    doubled = {"device": "cuda", "dtype": torch.float64}
    items[:] = [each for each in items if not doubled.items() <= getattr(each, "callspec", NO_CALL).params.items()]
    for item in items:
        fixtures = set(item.fixturenames) if isinstance(item, pytest.Function) else set()
        if RUNS & fixtures:
            item.add_marker(pytest.mark.slow)
        folder = item.path.relative_to(here).parts[0] if item.path.is_relative_to(here) else ""
        if folder in LAB or {*RUNS, "site"} & fixtures:
            item.add_marker(pytest.mark.lab)
    items.sort(key=lambda item: "site" not in getattr(item, "fixturenames", ()))  # what takes longest begins first


@pytest.fixture(scope="module", params=[torch.float32, torch.float64], ids=str)
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    """Single and double precision."""
    return request.param


@pytest.fixture(params=["cpu", "cuda"])
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """The CPU and a GPU, which is pretended on a machine without one (`tests.pretended`)."""
    with a_gpu() if request.param == "cuda" else nullcontext():
        yield torch.device(request.param)


@pytest.fixture
def one_thread() -> None:
    """Use one thread, so that results are reproducible to the bit."""
    torch.set_num_threads(1)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """Restore the number of threads after each test, which commands and `one_thread` change."""
    before = torch.get_num_threads()
    try:
        return (yield)
    finally:
        torch.set_num_threads(before)


@pytest.fixture(scope="session", autouse=True)
def parsers() -> Iterator[None]:
    """Make the parser of a command once for all tests that call it: a command of a user makes it once, too."""
    from semfov.runs import command

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "make_parser", cache(command.make_parser))
        yield


@pytest.fixture(scope="module")
def few_samples() -> Iterator[None]:
    """Draw few samples for the errors of a study's tables; what many samples give is tested in `lab/test_tables`."""
    from eval.bootstrap import Bootstrap
    from eval.chance import errors_by_chance

    with pytest.MonkeyPatch.context() as patch:
        for draw in (Bootstrap.of, errors_by_chance):
            patch.setitem(draw.__kwdefaults__, "samples", 20)
        yield


@pytest.fixture(scope="module")
def few_viewers() -> Iterator[None]:
    """Draw few viewers of a prediction; what many of them agree on is tested in `paths/test_gaze`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("semfov.paths.gaze._VIEWERS", 5)
        yield


FRESH = """
import json, os, sys
import semfov, torch
for line in sys.stdin:
    code, folder = json.loads(line)
    child = os.fork()
    if not child:
        for name, stream in (("out", sys.stdout), ("err", sys.stderr)):
            os.dup2(os.open(f"{folder}/{name}", os.O_CREAT | os.O_TRUNC | os.O_WRONLY), stream.fileno())
        try:
            exec(code, {"__name__": "__main__"})
            status = 0
        except SystemExit as stopped:
            status = stopped.code or 0
        except BaseException:
            status = 1
            sys.excepthook(*sys.exc_info())
        sys.stdout.flush()
        os._exit(status)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
"""A process that has imported semfov and nothing else, and runs code in copies of itself."""


@pytest.fixture(scope="session")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], str]]:
    """Runs code in a process of its own, in which semfov has just been imported, and returns what it prints."""
    if not hasattr(os, "fork"):
        pytest.skip("needs fork")
    folder = tmp_path_factory.mktemp("fresh")
    call, ways = [sys.executable, "-c", FRESH], {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(call, cwd=Path(__file__).parents[1], **ways) as process:  # type: ignore[call-overload]

        def run(code: str) -> str:
            process.stdin.write(json.dumps([code, str(folder)]) + "\n")
            process.stdin.flush()
            assert process.stdout.readline().strip() == "0", (folder / "err").read_text()
            return (folder / "out").read_text()

        yield run
        process.stdin.close()


class Quiet(SimpleHTTPRequestHandler):
    """A request handler that prints no log."""

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def serve() -> Iterator[Callable[[Path], str]]:
    """Serves a folder on this machine until the test ends, and returns its address."""
    with ExitStack() as stack:

        def start(folder: Path) -> str:
            server = stack.enter_context(ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)))
            threading.Thread(target=server.serve_forever, daemon=True).start()
            stack.callback(server.shutdown)
            return f"http://127.0.0.1:{server.server_port}"

        yield start


@pytest.fixture(scope="session")
def reader(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, object]]:
    """A reader's folder, and what code of a reader takes as given."""
    from tests.reader import fill

    folder = tmp_path_factory.mktemp("reader")
    return folder, fill(folder)


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of the development photographs and models."""
    folder = Path(os.environ.get("SEMFOV_SHARED", Path(__file__).parents[2] / "shared"))
    if not (folder / "coco").is_dir():
        pytest.skip(f"no development data in {folder} (set SEMFOV_SHARED)")
    return folder
