"""Every command runs, writes its files, goes on after a kill, and gives the same bits however its work is divided."""

import importlib
import json
import os
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
import torch
import yaml
from safetensors import safe_open

from tests.lab.commands.table import COMMANDS, MODEL, RUN, write_material
from tests.small import once

pytestmark = pytest.mark.usefixtures("few_samples")

ROOT = Path(__file__).parents[3]


def words(name, folder, *more, workers=1):
    """Words of a small run that writes to `out` and `cache` in a folder."""
    command, (_, *job) = COMMANDS[name], name.split()
    paths = ["--out", str(folder / "out"), "--cache", str(folder / "cache")]
    return once([*job, *more, *paths, *(["--workers", str(workers)] if command.workers else [])])


def run(name, *arguments):
    """Run a command in this process with one thread; returns its exit code."""
    torch.set_num_threads(1)
    return importlib.import_module(name.split()[0]).main(list(arguments))


def contents(name, folder):
    return {file: (folder / "out" / file).read_bytes() for file in COMMANDS[name].files}


@pytest.fixture(scope="module")
def material(tmp_path_factory):
    folder = tmp_path_factory.mktemp("material")
    write_material(folder)
    return folder


@pytest.fixture(scope="module")
def runs():
    """Folders of finished runs, by the name of the command."""
    return {}


@pytest.fixture(scope="module", params=RUN)
def finished(request, material, runs, tmp_path_factory):
    """A command, the settings of its small run, and the folder of the finished run."""
    name = request.param
    settings = [word.replace("HERE", str(material)) for word in COMMANDS[name].settings]
    if name not in runs:
        runs[name] = tmp_path_factory.mktemp("command")
        assert run(name, *words(name, runs[name], *settings)) == 0
    return name, settings, runs[name]


def test_a_run_writes_its_files(finished):
    name, _, folder = finished
    for file in (*COMMANDS[name].files, *COMMANDS[name].others):
        assert (folder / "out" / file).stat().st_size > 20, file
    assert not list(folder.rglob("*.part"))


@pytest.mark.parametrize("finished", [f"train.fit_{name}" for name in ("search", "verification")], indirect=True)
def test_a_fitted_model_says_what_it_was_fitted_to_and_with_which_settings(finished):
    _, settings, folder = finished
    with safe_open(folder / "out" / MODEL, "pt") as file:
        (record,) = map(json.loads, file.metadata().values())
    metadata = record["metadata"]
    assert metadata["detector"]["name"] == "colours"
    assert str(metadata["training"]["looks"]) == settings[settings.index("--looks") + 1]
    assert metadata["data"]


def long(name, *more, usual=("eval.search",)):
    """A run of a command that repeats what that of another shows, unless it is one of the usual ones."""
    return pytest.param(name, *more, marks=[] if name in usual else pytest.mark.long)


@pytest.mark.parametrize("finished", [long(name) for name in RUN if COMMANDS[name].workers], indirect=True)
def test_the_same_bits_from_two_workers(finished, tmp_path):
    name, settings, folder = finished
    assert run(name, *words(name, tmp_path, *settings, workers=2)) == 0
    assert contents(name, tmp_path) == contents(name, folder)


SHARE = {"no store": ("eval.search",), "small batches": ()}
"""Commands that are enough: `lab/test_scenes` has the other store, and the tests of the protocols have batches."""


@pytest.mark.parametrize(
    ("finished", "change"),
    [long(name, change, usual=SHARE.get(change, RUN)) for name in RUN for change in COMMANDS[name].same],
    indirect=["finished"],
)
def test_the_same_bits_with_settings_that_change_only_how_it_is_computed(finished, change, tmp_path):
    name, settings, folder = finished
    assert run(name, *words(name, tmp_path, *settings, *COMMANDS[name].same[change])) == 0
    assert contents(name, tmp_path) == contents(name, folder)


def parts_of(name, folder):
    """When each finished part was made, by its file or by its row in a database, and how much it holds."""
    found = {}
    for path in folder.glob(COMMANDS[name].parts) if COMMANDS[name].parts else ():
        if path.suffix == ".sqlite":
            with closing(sqlite3.connect(path)) as database:
                rows = database.execute("SELECT number, seconds, length(records) FROM scenes").fetchall()
            found |= {(path, number): made for number, *made in rows}
        else:
            found[path, 0] = [path.stat().st_mtime_ns, path.stat().st_size]
    return found


def damage(part):
    path, number = part
    if path.suffix == ".sqlite":
        with closing(sqlite3.connect(path)) as database, database:
            database.execute("UPDATE scenes SET records = '[]' WHERE number = ?", (number,))
    else:
        path.write_bytes(path.read_bytes()[:-40])


def test_finished_parts_are_kept_and_a_damaged_one_is_computed_again(finished):
    name, settings, folder = finished
    torch.manual_seed(1)  # random numbers drawn elsewhere change nothing
    expected = contents(name, folder)
    kept = parts_of(name, folder)
    assert len(kept) > 1 or not COMMANDS[name].parts
    damaged = min(kept, default=None)
    if damaged is not None:
        damage(damaged)
    broken = parts_of(name, folder)
    for file in COMMANDS[name].files:
        (folder / "out" / file).unlink()
    assert run(name, *words(name, folder, *settings)) == 0
    assert contents(name, folder) == expected
    found = parts_of(name, folder)
    assert found.keys() == kept.keys()
    assert {part for part in kept if found[part] != kept[part]} <= {damaged}
    assert damaged is None or found[damaged][-1] > broken[damaged][-1]


@pytest.mark.parametrize("finished", [long("eval.search"), long("train.fit_fom")], indirect=True)
def test_the_same_bits_from_two_ranks(finished, tmp_path):
    name, settings, folder = finished
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", name]
    call, environment = words(name, tmp_path, *settings), {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([*launch, *call], cwd=ROOT, check=True, capture_output=True, env=environment)
    assert contents(name, tmp_path) == contents(name, folder)


WRONG = [(name, *each) for name, command in COMMANDS.items() for each in command.refused]


@pytest.mark.parametrize(("name", "wrong", "message"), WRONG, ids=[f"{name} {' '.join(w)}" for name, w, _ in WRONG])
def test_wrong_settings_are_refused_in_one_line(name, wrong, message, tmp_path, capsys):
    assert run(name, *name.split()[1:], *wrong, "--out", str(tmp_path / "out")) == 1
    error = capsys.readouterr().err.splitlines()
    assert error[-1].startswith("error: ")
    assert message in error[-1]
    assert not list(tmp_path.rglob("*.safetensors"))


def test_an_output_that_cannot_be_written_is_named(material, tmp_path, capsys):
    (tmp_path / "out").write_text("a file")
    settings = [word.replace("HERE", str(material)) for word in COMMANDS["eval.search"].settings]
    assert run("eval.search", *words("eval.search", tmp_path, *settings)) == 1
    assert str(tmp_path / "out") in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("name", ["eval.search", "eval.human viewing", "semfov.cli.main fit"])
def test_unknown_settings_are_refused(name, capsys):
    with pytest.raises(SystemExit) as stopped:
        run(name, *name.split()[1:], "--seeed", "3")
    assert stopped.value.code == 2
    assert "seeed" in capsys.readouterr().err


@pytest.mark.parametrize("name", [name for name in COMMANDS if not name.startswith("semfov.")])
def test_help_describes_the_command_and_printed_settings_can_be_given_back(name, capsys, tmp_path):
    module, *job = name.split()
    with pytest.raises(SystemExit) as stopped:
        run(name, *job, "--help")
    assert stopped.value.code == 0
    printed = capsys.readouterr().out
    assert importlib.import_module(module).__doc__.splitlines()[0] in printed
    assert "--config" in printed
    texts = []
    for given in ([], ["--config", str(tmp_path / "settings.yaml")]):
        with pytest.raises(SystemExit) as stopped:
            run(name, *job, *given, "--out", "elsewhere", "--print_config")
        assert stopped.value.code == 0
        texts.append(capsys.readouterr().out)
        (tmp_path / "settings.yaml").write_text(texts[-1])
    assert texts[0] == texts[1]
    assert yaml.safe_load(texts[0])["out"] == "elsewhere"
