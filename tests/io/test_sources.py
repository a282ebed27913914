"""What is kept of sources between processes equals what is read from them anew, and nothing stale is taken."""

import json

import pytest

from semfov.io import code, sources

BODY = b'"""Adds."""\nimport math\nfrom . import a, b\nfrom ..c import d\ndef add(x, y):\n    return x + y\n'


@pytest.fixture
def new_process(tmp_path, monkeypatch):
    """Function that forgets what was read, as a new process with an own cache does; what is kept in files stays."""
    monkeypatch.setenv("SEMFOV_CACHE", str(tmp_path / "cache"))

    def begin():
        sources._kept.cache_clear()
        code.package_digest.cache_clear()
        code.modules_digest.cache_clear()

    begin()
    yield begin
    begin()


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "module.py"
    path.write_bytes(BODY)
    return path


def kept_file(tmp_path):
    (found,) = (tmp_path / "cache" / "code").iterdir()
    return found


def test_a_later_process_reads_no_syntax_tree(new_process, file, monkeypatch):
    first = sources.read_source(file)
    package, modules = code.package_digest(), code.modules_digest("semfov.runs.store", "semfov.io.code")
    sources.keep_sources()
    new_process()
    monkeypatch.setattr(sources, "_parse", None)
    assert sources.read_source(file) == first
    assert code.package_digest() == package
    assert code.modules_digest("semfov.runs.store", "semfov.io.code") == modules


def test_other_code_has_another_digest_whatever_is_kept(new_process, file):
    first = sources.read_source(file)
    sources.keep_sources()
    file.write_bytes(BODY.replace(b"x + y", b"x - y"))
    new_process()
    other = sources.read_source(file)
    assert other.digest != first.digest
    file.write_bytes(BODY.replace(b"Adds", b"Sums") + b"# the end\n")
    assert sources.read_source(file) == first, "comments and docstrings do not count"
    assert other.imports == first.imports


def test_imports_of_a_source(new_process, file):
    """`from . import a` in `p.q.module` names `p.q` and `p.q.a`."""
    imports = sources.read_source(file).imports
    names = [name for statement in imports for name in statement.modules("p.q")]
    assert names == ["math", "p.q.a", "p.q.b", "p.q", "p.c.d", "p.c"]


@pytest.mark.parametrize(
    "damage", [b"", b"[1, 2]", b'{"0": 5}', b'{"0": ["a", [5]]}', b'{"0": ["a", [[1]]]', b"\xff\0"]
)
def test_a_damaged_file_is_written_anew(new_process, file, tmp_path, damage):
    first = sources.read_source(file)
    sources.keep_sources()
    kept_file(tmp_path).write_bytes(damage)
    new_process()
    assert sources.read_source(file) == first
    sources.keep_sources()
    assert any(entry[0] == first.digest for entry in json.loads(kept_file(tmp_path).read_bytes()).values())


def test_another_version_of_the_reader_takes_nothing_that_was_kept(new_process, file, tmp_path, monkeypatch):
    sources.read_source(file)
    sources.keep_sources()
    monkeypatch.setattr(sources.sys, "version", "another")
    new_process()
    assert not sources._kept()._sources
    sources.read_source(file)
    sources.keep_sources()
    assert len(list((tmp_path / "cache" / "code").iterdir())) == 2


def test_the_oldest_sources_are_dropped(new_process, file, tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "_MOST_SOURCES", 2)
    digests = []
    for number in range(4):
        file.write_text(f"x = {number}\n")
        digests.append(sources.read_source(file).digest)
        sources.keep_sources()
    assert [digest for digest, _ in json.loads(kept_file(tmp_path).read_bytes()).values()] == digests[2:]


@pytest.mark.parametrize("place", ["a file", "a name of a file", "no permission"])
def test_without_a_cache_each_process_reads_the_sources(new_process, file, tmp_path, monkeypatch, place):
    cache = tmp_path / "cache"
    if place == "a file":
        cache.write_text("")
    elif place == "a name of a file":
        (tmp_path / "cache").mkdir()
        (tmp_path / "cache" / "code").write_text("")
    else:
        monkeypatch.setattr(sources, "write_text", _refuse)
    new_process()
    first = sources.read_source(file)
    sources.keep_sources()
    new_process()
    assert sources.read_source(file) == first


def _refuse(path, text):
    raise sources.DataError(f"cannot write {path}")
