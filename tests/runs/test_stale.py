"""Stored results of other code or other images are not used, and do not depend on threads."""

import errno
import logging
import os
import re
import shutil
import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from eval.comparison.records import StoredRecords
from eval.search.run import SearchConfig, SearchRun
from semfov.errors import DataError, InputError
from semfov.gaze.acquisition import FUNCTIONS, TargetPosterior
from semfov.io.files import disk_is_full
from semfov.runs import policy_looking, scene_run
from semfov.runs.config import PolicyConfig
from semfov.runs.results import SceneResults
from semfov.runs.scene_run import finish
from tests.refusals import unusable
from tests.small import run_settings

ROOT = Path(__file__).parents[2]


def outcomes(results, index):
    """The outcomes of a scene; None if they are missing or damaged."""
    return dict(results.items(index + 1)).get(index)


@pytest.fixture
def config(tmp_path):
    return SearchConfig(**run_settings(tmp_path, 1, 3, 2, starts=2, shifts=3), policies=("random",))


@pytest.mark.slow
@pytest.mark.lab
def test_a_run_finished_by_other_code_is_reported_and_computed_again(config, monkeypatch, caplog):
    first = SearchRun(config)
    finish(first, "searching")
    assert outcomes(first.results, 0) is not None
    finish(SearchRun(config), "searching")
    assert not caplog.records
    monkeypatch.setattr(scene_run, "package_digest", lambda: "0" * 64)
    second = SearchRun(config)
    assert second.key.partition("-")[0] == first.key.partition("-")[0]
    assert second.key != first.key
    assert second.store.key == first.store.key, "stored looks do not depend on the code of the search"
    assert outcomes(second.results, 0) is None
    with caplog.at_level(logging.WARNING):
        finish(second, "searching")
    (record,) = caplog.records
    assert "1 scenes were finished with these settings by another version of the code" in record.getMessage()
    assert outcomes(second.results, 0) is not None


def test_only_other_code_is_reported_for_scenes_that_are_left(tmp_path, monkeypatch, caplog):
    def tasks(function, todo, **options):
        yield from ((index, ([{"scene": index}], {}, None)) for index in todo)

    def run_of(key):
        config = SimpleNamespace(out=tmp_path, where=1)
        results = SceneResults(tmp_path, key, str)
        return SimpleNamespace(scenes=range(3), config=config, results=results, digest=str)

    monkeypatch.setattr(scene_run, "run_tasks", tasks)
    interrupted = run_of("settings-code")
    interrupted.results.save(1, [{"scene": 1}], {})
    finish(interrupted, "searching")
    assert not caplog.records
    assert [each["records"][0]["scene"] for each in interrupted.results.read(3)] == [0, 1, 2]
    with caplog.at_level(logging.WARNING):
        finish(run_of("settings-other"), "searching")
    assert "3 scenes were finished with these settings by another version" in caplog.text


def test_the_key_depends_on_the_code_of_a_user_defined_policy(config, tmp_path, monkeypatch):
    class Own(TargetPosterior):
        name = "own-of-a-test"

    try:
        chosen = replace(config, policies=(PolicyConfig("own-of-a-test"),))
        key = SearchRun(chosen).key
        assert SearchRun(chosen).key == key
        monkeypatch.setattr(policy_looking, "class_digest", lambda kind: "changed")
        assert SearchRun(chosen).key != key
        assert SearchRun(config).key.partition("-")[0] != SearchRun(chosen).key.partition("-")[0]
    finally:
        del FUNCTIONS["own-of-a-test"]


def test_a_part_of_another_image_is_not_loaded(tmp_path):
    digest = {"now": "a" * 64}
    results = SceneResults(tmp_path, "1-2", lambda index: digest["now"])
    results.save(3, [{"policy": "random"}], {"look": 0.5})
    assert outcomes(results, 3)["records"] == [{"policy": "random"}]
    digest["now"] = "b" * 64
    assert outcomes(results, 3) is None


@pytest.mark.parametrize(
    "damage",
    [
        {"seconds": "null"},
        {"seconds": '{"look": null}'},
        {"records": "null"},
        {"records": "[1]"},
        {"records": '[{"policy": "entropy"}]'},
        {"records": "[" * 10_000},
        {"records": b"\xff"},
        {"sha256": "0"},
        {"number": 1},
    ],
    ids=str,
)
def test_outcomes_that_are_damaged_count_as_missing(tmp_path, damage):
    results = SceneResults(tmp_path, "1-2", lambda index: "a")
    results.save(0, [{"policy": "random"}], {"look": 0.5})
    results.save(2, [{"policy": "kl"}], {"look": 0.25})
    assert results.finished(3) == {0, 2}
    assert results.finished(2) == {0}
    with closing(sqlite3.connect(results.path)) as database, database:
        ((column, value),) = damage.items()
        database.execute(f"UPDATE scenes SET {column} = ? WHERE number = 0", (value,))
    assert outcomes(results, 0) is outcomes(results, 1) is None
    assert results.finished(3) == {2}
    assert outcomes(results, 2) == {"records": [{"policy": "kl"}], "seconds": {"look": 0.25}}
    unusable("scene 0 is missing or damaged; run the same command again", lambda: [*results.read(3)])


def test_a_file_that_is_no_database_counts_as_missing_and_is_replaced(tmp_path):
    results = SceneResults(tmp_path, "1-2", lambda index: "a")
    for content in (b"[" * 100_000, b"\xff\xfe", b"", b"SQLite format 3\0" * 999):
        results.path.write_bytes(content)
        assert outcomes(results, 0) is None
        assert results.finished(9) == set()
        results.save(0, [{"policy": "random"}], {"look": 0.5})
        assert outcomes(results, 0)["records"] == [{"policy": "random"}]
    os.truncate(results.path, results.path.stat().st_size // 2)
    assert results.finished(1) == set()
    results.path.unlink()
    os.mkfifo(results.path)
    unusable("expected a file, got a pipe", outcomes, results, 1)


def test_a_full_disk_is_known_where_outcomes_cannot_be_written(tmp_path, monkeypatch):
    def no_space(*_, **__):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    results = SceneResults(tmp_path, "1-2", lambda index: "a")
    monkeypatch.setattr(sqlite3, "connect", no_space)
    with pytest.raises(DataError, match=f"cannot write {re.escape(str(results.path))}: .*No space left") as caught:
        results.save(0, [{"policy": "random"}], {"look": 0.5})
    assert disk_is_full(caught.value)


def test_what_a_killed_process_has_half_written_is_undone(tmp_path):
    """Its journal lies beside the database, which is read nevertheless: the scenes before are still there."""
    whole, left = (SceneResults(tmp_path / name, "1-2", lambda index: "a") for name in ("whole", "left"))
    for index in range(9):
        whole.save(index, [{"policy": "random"}], {"look": 0.5})
    assert whole.finished(9) == {*range(9)}
    with closing(sqlite3.connect(whole.path)) as database:
        database.execute("PRAGMA cache_size = 1")
        database.execute("BEGIN")
        database.execute("UPDATE scenes SET sha256 = '0'")
        for index in range(9, 20):
            database.execute("INSERT INTO scenes VALUES (?, '0', '{}', ?)", (index, "x" * 50_000))
        shutil.copytree(whole.path.parent, left.path.parent)
    assert [path.name for path in left.path.parent.glob("*-journal")]
    assert left.finished(20) == {*range(9)}
    assert len([*left.read(9)]) == 9


def test_records_are_read_one_scene_at_a_time(tmp_path):
    """They come in the order of the scenes, whatever the order in which they were finished, and again when asked."""
    results = SceneResults(tmp_path, "1-2", lambda index: "a")
    for number in (2, 0, 1):
        results.save(number, [{"scene": number, "turn": turn} for turn in range(2)], {"look": 0.5 * number})
    stored = StoredRecords(results, 3)
    expected = [{"scene": scene, "turn": turn} for scene in range(3) for turn in range(2)]
    assert [*stored] == [*stored] == expected
    assert stored.seconds == {"look": 1.5}
    assert next(iter(StoredRecords(results, 4))) == expected[0]


@pytest.mark.slow
def test_a_deleted_store_file_is_written_identically_with_more_threads(config):
    run = SearchRun(config)
    finish(run, "searching")
    (file,) = (config.cache / "looks").rglob("*.safetensors")
    content = file.read_bytes()
    file.unlink()
    torch.set_num_threads(4)
    again = SearchRun(config)
    again.detections(0)
    assert torch.get_num_threads() == 4
    assert file.read_bytes() == content


def test_a_policy_given_twice_is_refused(config):
    for policies in (
        ("random", "random"),
        ("random", PolicyConfig("random")),
        ("recommended", "non-predictive-learned"),
    ):
        with pytest.raises(InputError, match=r"^policies: expected each policy once, got '.*' 2 times"):
            SearchRun(replace(config, policies=policies))


def test_parts_of_other_library_versions_are_not_loaded(config, monkeypatch):
    key = SearchRun(config).key
    monkeypatch.setattr(scene_run, "versions", lambda: {"torch": "another"})
    assert SearchRun(config).key != key


def test_a_database_whose_columns_have_damaged_names_counts_as_missing(tmp_path):
    results = SceneResults(tmp_path, "1-2", lambda index: "a")
    results.save(0, [{"policy": "random"}], {"look": 0.5})
    results.flush()
    results.path.write_bytes(results.path.read_bytes().replace(b"records", b"rec\xd1rds"))
    assert outcomes(results, 0) is None
    assert results.finished(1) == set()
