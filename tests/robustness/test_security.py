"""Untrusted files are only data: nothing in them is executed, and no path leads outside their folder."""

import ast
import io
import pickle
import tarfile
from pathlib import Path

import pytest
import torch

from semfov import DataError, load_detector
from semfov.detection.weights import WEIGHTS, _Address, _SourceDistribution
from tests.refusals import unusable
from train.coco import _ANNOTATIONS, _SPLITS

ROOT = Path(__file__).parents[2]
SOURCES = [
    file for folder in ("semfov", "eval", "train", "examples") for file in sorted((ROOT / folder).rglob("*.py"))
] + [ROOT / "hubconf.py"]

CLASSES = [f"class {n}" for n in range(1, 91)]


def unsafe_calls(source: str) -> list[str]:
    """Calls that can execute the content of a file, or read one of any kind, beside those that ruff finds."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            name, given = ast.unparse(node.func), {word.arg: ast.unparse(word.value) for word in node.keywords}
            wanted = {"torch.load": ("weights_only", "True"), "rasterio.open": ("driver",), "Image.open": ("formats",)}
            bad = name in wanted and not set(wanted[name]) <= {*given, *given.values()}
            bad |= name in ("np.load", "numpy.load") and given.get("allow_pickle", "False") != "False"
            if bad or name.split(".")[-1] in ("extract", "unpack_archive", "load_state_dict_from_url", "load_url"):
                found.append(f"line {node.lineno}: {ast.unparse(node)[:80]}")
    return found


def test_sources_have_no_unsafe_calls():
    for line in (
        "torch.load(path, weights_only=False)",
        "tar.extract(name)",
        "np.load(path, allow_pickle=True)",
        "rasterio.open(path)",
        "Image.open(path)",
    ):
        assert unsafe_calls(line)
    assert not unsafe_calls("torch.load(path, weights_only=True)")
    assert {str(file): found for file in SOURCES if (found := unsafe_calls(file.read_text(encoding="utf-8")))} == {}


def test_every_download_is_pinned():
    assert isinstance(WEIGHTS["yolov3-tiny"].sources[0], _SourceDistribution)
    assert len({entry.file for entry in WEIGHTS.values()}) == len(WEIGHTS)
    for name, entry in WEIGHTS.items():
        assert len(bytes.fromhex(entry.sha256)) == 32, name
        assert entry.size > 0
        assert entry.licence
        assert entry.sources or "https://" in entry.remark
        for source in entry.sources:
            assert isinstance(source, _Address | _SourceDistribution)
            if isinstance(source, _Address):
                assert source.url.startswith("https://")
            else:
                assert len(bytes.fromhex(source.sha256)) == 32
    for archive in (*_SPLITS.values(), _ANNOTATIONS):
        assert len(bytes.fromhex(archive.sha256)) == 32


class Unsafe:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_a_pickled_checkpoint_is_refused(tmp_path):
    mark, weights = tmp_path / "run", tmp_path / "weights.pth"
    torch.save({"weight": torch.zeros(1), "evil": Unsafe(mark)}, weights)
    with pytest.raises(DataError, match=r"weights\.pth"):
        load_detector("torchvision:ssdlite320_mobilenet_v3_large", weights=weights, classes=CLASSES)
    assert not mark.exists()
    pickle.loads(pickle.dumps(Unsafe(mark)))
    assert mark.exists()


def test_settings_that_would_run_code_are_refused(tmp_path, capsys):
    from eval.search import main

    mark, settings = tmp_path / "run", tmp_path / "settings.yaml"
    settings.write_text(
        f"out: !!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path ['{mark}']]"
    )
    with pytest.raises(SystemExit) as stopped:
        main(["--config", str(settings)])
    assert stopped.value.code == 2
    assert "python/object" in capsys.readouterr().err
    assert not mark.exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("seed: " + "[" * 200_000, "expected lists and objects at most 100 deep, got deeper ones"),
        ("a: &a [1, 2]\nseed: *a\n", "line 2: expected values, got the alias *a"),
    ],
)
def test_settings_that_would_fill_the_memory_or_the_stack_are_refused(tmp_path, capsys, text, said):
    from eval.search import main

    (tmp_path / "settings.yaml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        main(["--config", str(tmp_path / "settings.yaml")])
    assert stopped.value.code == 2
    assert said in capsys.readouterr().err


def archive(path: Path, *members: tuple[str, bytes | None, str]) -> None:
    """Write a tar file with members of (name, content, target of a link)."""
    with tarfile.open(path, "w:gz") as tar:
        for name, content, link in members:
            entry = tarfile.TarInfo(name)
            if content is None:
                entry.type, entry.linkname = tarfile.SYMTYPE, link
            else:
                entry.size = len(content)
            tar.addfile(entry, None if content is None else io.BytesIO(content))


@pytest.mark.parametrize("target", ["../../../../etc/passwd", "/etc/passwd", "p-1/other"])
def test_nothing_is_extracted_from_archives_with_links_or_outside_paths(tmp_path, monkeypatch, target):
    """Members with outside paths are not extracted, and a link is not followed."""
    source = _SourceDistribution("p", "1", "0" * 64, "p-1/weights")

    def download(self, folder: Path) -> None:
        (folder / "archives").mkdir()
        archive(
            folder / "archives" / "p-1.tar.gz",
            ("../../escaped", b"out", ""), ("/tmp/semfov-escaped", b"out", ""), ("p-1/weights", None, target),
        )  # fmt: skip

    monkeypatch.setattr(_SourceDistribution, "_download", download)
    destination = tmp_path / "weights"
    unusable("lacks", source.fetch, destination)
    assert not Path("/tmp/semfov-escaped").exists()
    assert [file.name for file in tmp_path.iterdir()] in ([], ["weights"])
    assert not destination.exists() or destination.read_bytes() == b""
