"""Consistency of the project's setup: versions, pinned dependencies, and checks before a commit and on the server."""

import os
import re
import runpy
import shlex
import subprocess
import sys
import tomllib
import zipfile
from dataclasses import fields
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

import semfov
from semfov.cli.main import _options_of

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
RECIPES = dict(
    re.findall(r"^([\w-]+):(.*\n(?:\t.*\n)*)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
)
LOCKS = {
    name: (ROOT / name).read_text(encoding="utf-8") for name in ("constraints.txt", ".ci/app.txt", ".ci/build.txt")
}
PINS = {name: dict(re.findall(r"^([\w.-]+)==([\w.]+)", text, re.MULTILINE)) for name, text in LOCKS.items()}


def read(path):
    return yaml.safe_load((ROOT / path).read_text(encoding="utf-8"))


def required(*extras):
    """Requirements of the package and of the given extras, including extras that refer to other extras."""
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in PROJECT["optional-dependencies"][extra])]
    for requirement in map(Requirement, texts):
        if requirement.name == PROJECT["name"]:
            yield from required(*requirement.extras)
        else:
            yield requirement


def test_citation_and_changelog_have_the_version_of_the_package():
    assert PROJECT["dynamic"] == ["version"]
    assert read("CITATION.cff")["version"] == semfov.__version__
    released = re.findall(r"^## (\d+\.\d+\.\d+), (\d{4}-\d\d-\d\d)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert released[0] == (semfov.__version__, read("CITATION.cff")["date-released"].isoformat())


@pytest.mark.parametrize(
    "requirement", sorted({str(each): each for each in required("dev")}.values(), key=str), ids=str
)
def test_pins_of_the_tests_are_within_the_bounds_for_users(requirement):
    assert PINS["constraints.txt"][canonicalize_name(requirement.name)] in requirement.specifier


@pytest.mark.parametrize("name", LOCKS)
def test_each_pinned_version_has_digests_and_no_registry(name):
    lines = [line for line in LOCKS[name].replace("\\\n", "").splitlines() if line[0] != "#"]
    pin = r"[\w.-]+==[\w.]+( ; [\w<>=!'. ()]+)?(\s+--hash=sha256:[0-9a-f]{64})+"
    assert [line for line in lines if not re.fullmatch(pin, line.strip())] == []


def test_what_is_installed_before_tests_and_releases_and_actions_are_pinned():
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert "$(STAMP): pyproject.toml constraints.txt" in makefile
    assert makefile.count("' constraints.txt\n") == 1  # which is split in parts
    assert re.findall(r"pip \$\(INSTALL\)( \S+)?$", makefile, re.MULTILINE) == ["", " .ci/app.txt"]
    assert re.search("^INSTALL := install .*--require-hashes --requirement$", makefile, re.MULTILINE)
    release = (ROOT / ".github/workflows/release.yml").read_text(encoding="utf-8")
    assert "install --require-hashes --requirement .ci/build.txt && python -m build --no-isolation" in release
    assert all(PINS[".ci/app.txt"].get(each.name, "6") in each.specifier for each in required("app"))
    for path in (ROOT / ".github/workflows").glob("*.yml"):
        used = re.findall(r"uses: (.*)", path.read_text(encoding="utf-8"))
        assert used
        assert [each for each in used if not re.match(r"[\w./-]+@[0-9a-f]{40} # v", each)] == []


PYTHON = """
import os, shlex, shutil, sys
with open(CALLS, "a") as calls:
    calls.write(shlex.join(sys.argv[1:]) + "\\n")
if sys.argv[2] == "venv":
    os.makedirs(sys.argv[3] + "/bin", exist_ok=True)
    shutil.copy(__file__, sys.argv[3] + "/bin/python")
"""
"""A Python that only writes down what it is asked for, as a shell would read it."""


def set_up(folder, *settings, **environment):
    """Run `make setup` with a Python that only writes down what it is asked for; returns the process and its calls."""
    python, calls = folder / "python3", folder / "calls.txt"
    calls.unlink(missing_ok=True)
    python.write_text(f"#!{sys.executable} -IS\n{PYTHON.replace('CALLS', repr(str(calls)))}")
    python.chmod(0o755)
    call = ["make", "setup", f"PYTHON={python}", f"VENV={folder}/venv", *settings]
    # Also within another make.
    alone = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "CPU_WHEELS", "CPU")}
    done = subprocess.run(call, cwd=ROOT, env=alone | environment, capture_output=True, text=True, check=False)
    return done, calls.read_text(encoding="utf-8").splitlines() if calls.exists() else []


def write_wheel(folder, name, version):
    """Write a wheel of a package that holds nothing but its name and version."""
    about = f"{name}-{version}.dist-info"
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as wheel:
        wheel.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        wheel.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{about}/RECORD", "")


def test_set_up_with_builds_for_the_cpu_takes_them_from_a_folder_and_no_cuda(tmp_path):
    wheels = tmp_path / "my wheels"
    wheels.mkdir()
    names = ("torch", "torchvision")
    for name in names:
        write_wheel(wheels, name, f"{PINS['constraints.txt'][name]}+cpu")
    done, calls = set_up(tmp_path, f"CPU_WHEELS={wheels}")
    assert done.returncode == 0, done.stderr
    _, others, builds, *_ = calls
    pinned = PINS["constraints.txt"]
    text = Path(others.split()[-1]).read_text(encoding="utf-8")
    assert set(re.findall(r"^([\w.-]+)==", text, re.MULTILINE)) == {
        name for name in pinned if not re.match("nvidia|cuda|triton", name) and name not in names
    }
    assert not re.search("--require-hashes", builds)
    call = [sys.executable, *shlex.split(builds), "--dry-run", "--ignore-installed", "--disable-pip-version-check"]
    tried = subprocess.run([each for each in call if each != "--quiet"], capture_output=True, text=True, check=True)
    assert f"Would install torch-{pinned['torch']}+cpu torchvision-{pinned['torchvision']}+cpu" in tried.stdout


def test_set_up_takes_builds_for_the_cpu_from_an_address_and_asks_for_it(tmp_path):
    done, calls = set_up(tmp_path, "CPU=1")
    assert (done.returncode, calls) == (2, [])
    assert "CPU: expected CPU_WHEELS=ADDRESS too" in done.stderr
    assert "PyTorch's install page (docs/install.md)" in done.stderr
    assert "https://pytorch.org/get-started/locally/" in (ROOT / "docs/install.md").read_text(encoding="utf-8")
    _, calls = set_up(tmp_path, "CPU=1", "CPU_WHEELS=https://builds.example.org/cpu")
    builds = next(call for call in calls if call.endswith("cpu.txt"))
    assert "--index-url https://builds.example.org/cpu" in builds
    assert "--no-index" not in builds


def test_later_calls_take_the_builds_that_an_environment_was_made_with(tmp_path):
    set_up(tmp_path, "CPU_WHEELS=my wheels")
    (tmp_path / "venv/.installed").unlink()  # as after a change of the pinned versions
    for settings, builds in ([], "'my wheels'"), (["CPU_WHEELS=others"], "others"), ([], "others"):
        done, calls = set_up(tmp_path, *settings)
        (tmp_path / "venv/.installed").unlink()
        assert done.returncode == 0, done.stderr
        assert [f"--no-index --find-links {builds} " in call for call in calls if call.endswith("cpu.txt")] == [True]


def test_set_up_without_further_settings_checks_the_digest_of_each_pinned_file(tmp_path):
    done, calls = set_up(tmp_path, CPU="x86_64")  # which other programs set
    assert done.returncode == 0, done.stderr
    parts = [call.split() for call in calls if ".txt" in call]
    assert all("--require-hashes" in part for part in parts)
    written = "".join(Path(part[-1]).read_text(encoding="utf-8") for part in parts)
    lines = (line for line in LOCKS["constraints.txt"].splitlines() if line[0] != "#")
    assert sorted(written.splitlines()) == sorted(lines)


def test_the_oldest_versions_are_the_lower_bounds():
    oldest = runpy.run_path(str(ROOT / ".ci" / "oldest.py"))["oldest"](PROJECT["dependencies"])
    assert [line.partition("==")[0] for line in oldest] == [Requirement(text).name for text in PROJECT["dependencies"]]
    assert all(
        line.partition("==")[2] in Requirement(text).specifier
        for line, text in zip(oldest, PROJECT["dependencies"], strict=True)
    )


def test_commands_of_workflows_exist_and_checks_before_a_commit_are_part_of_make_test():
    hooks = [hook for repo in read(".pre-commit-config.yaml")["repos"] for hook in repo["hooks"]]
    targets = [hook["entry"].removeprefix("make ") for hook in hooks]
    assert {"lint", "types"} <= set(targets) <= RECIPES.keys()
    assert {"lint", "types"} <= set(RECIPES["test"].split())
    jobs = {
        name: job
        for path in ("test", "docs", "release")
        for name, job in read(f".github/workflows/{path}.yml")["jobs"].items()
    }
    steps = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert {".ci/run", "make app", "make lab"} <= set(steps)
    assert {step.removeprefix("make ") for step in steps if step.startswith("make ")} <= RECIPES.keys()
    assert all((ROOT / name).is_file() for step in steps for name in re.findall(r"\.ci/[\w.]+", step))
    assert jobs["tested"]["strategy"]["matrix"]["os"] == ["ubuntu-latest", "macos-latest"]


def test_the_workflows_test_the_oldest_python_and_a_newer_one():
    supported = SpecifierSet(PROJECT["requires-python"])
    text = (ROOT / ".github/workflows/test.yml").read_text(encoding="utf-8")
    versions = re.findall(r'"(3\.\d+)"', text)
    assert all(version in supported for version in versions)
    assert f">={min(versions)}" == PROJECT["requires-python"] != f">={max(versions)}"
    tried = read(".github/workflows/release.yml")["jobs"]["try"]["strategy"]["matrix"]["python"]
    assert set(versions) == set(tried)


def test_the_commands_that_try_a_release_exist_and_issue_templates_are_valid():
    steps = [step["run"] for step in read(".github/workflows/release.yml")["jobs"]["try"]["steps"] if "run" in step]
    (commands,) = (step.split(" && ") for step in steps if step.startswith("semfov"))
    for command in commands:
        name, *options = command.split()[1:]
        known = {f"--{each.name}".replace("_", "-") for each in fields(_options_of(name))}
        assert {option for option in options if option.startswith("--")} <= known
    for path in (ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"):
        form = read(path.relative_to(ROOT))
        assert path.stem == "config" or {"name", "description", "body"} <= set(form)
