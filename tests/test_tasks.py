"""The pages by task run as printed, except that the default detector, whose weights the tests have, stands for others,
looks three times where they let it look more, and is fitted in few steps.

Commands of a checkout are not run: their programs exist and take the options.
"""

import logging
import re
import shlex
import shutil
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from semfov.cli.main import main

TASKS = Path(__file__).parents[1] / "docs" / "tasks"
PAGES = sorted(TASKS.glob("*.md"))
SHORTER = {
    "yolox-nano|nanodet-plus-m-1.5x": "yolov3-tiny",
    "(?<=passes[= ])16": "3",
    "(?<=shifts=)(5|10)": "2",
    "(?<=duration=)10": "3",
    "(?<=--gaze.seconds 5)": " --gaze.folds 2 --gaze.fit.epochs 2 --gaze.fit.saccade_epochs 1",
}
"""What is printed, and what runs in its place."""
RUN = [page for page in PAGES if "mymodels" not in page.read_text(encoding="utf-8")]  # a fit: tests/test_readme.py


@pytest.fixture(scope="module")
def filled(reader, tmp_path_factory):
    folder, given = reader
    return shutil.copytree(folder, tmp_path_factory.mktemp("tasks") / "reader", symlinks=True), given


@pytest.fixture
def kept_level():
    """A page sets what semfov logs."""
    log = logging.getLogger("semfov")
    level = log.level
    yield
    log.setLevel(level)


@pytest.mark.weights
@pytest.mark.slow
@pytest.mark.usefixtures("kept_level")
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.stem)
def test_a_page_runs_as_printed(page, filled, monkeypatch, capsys, one_thread):
    folder, given = filled
    monkeypatch.chdir(folder)
    names = dict(given)
    text = page.read_text(encoding="utf-8")
    for printed, run in SHORTER.items():
        text = re.sub(printed, run, text)
    for language, block in re.findall(r"```(python|sh)\n(.*?)```", text, re.DOTALL):
        if language == "python":
            exec(compile(block, page.name, "exec"), names)
            plt.close("all")
        else:
            for line in block.splitlines():
                assert main(shlex.split(line)[1:]) == 0, capsys.readouterr().err


def test_every_page_is_in_the_index_and_on_the_site():
    index, site = (TASKS / "index.md").read_text(encoding="utf-8"), (TASKS.parents[1] / "mkdocs.yml").read_text()
    for page in PAGES:
        assert page.stem == "index" or f"({page.name})" in index
        assert f"tasks/{page.name}" in site


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_code_fits_on_a_screen_and_needs_no_checkout(page):
    text = page.read_text(encoding="utf-8")
    for block in re.findall(r"```\w*\n(.*?)```", text, re.DOTALL):
        assert len(block.splitlines()) <= 30
    assert "needs a checkout" in text or not re.search(r"python -m (eval|train|benchmarks)|pip install -e", text)
