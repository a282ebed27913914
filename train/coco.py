"""Fetch the official COCO files, resumable, verified and unpacked: `python -m train.coco val2017 --root DIR`."""

import argparse
import contextlib
import hashlib
import json
import os
import shutil
import stat
import sys
import time
import zipfile
import zlib
from collections.abc import Sequence
from http.client import HTTPException, HTTPResponse
from pathlib import Path, PurePosixPath
from typing import NamedTuple
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

from semfov.errors import DataError, SemfovError, check, lookup

_ADDRESS = "http://images.cocodataset.org"
_CHUNK = 1 << 20
_TIMEOUT = 30.0
_ATTEMPTS = 3


class _Archive(NamedTuple):
    """A zip file on the server."""

    path: str
    size: int
    sha256: str

    @property
    def name(self) -> str:
        """File name."""
        return PurePosixPath(self.path).name


# COCO publishes no digests; these were recorded by many independent users of the files.
_ANNOTATIONS = _Archive(
    "annotations/annotations_trainval2017.zip",
    252_907_541,
    "113a836d90195ee1f884e704da6304dfaaecff1f023f49b6ca93c4aaae470268",
)
_SPLITS = {
    "val2017": _Archive(
        "zips/val2017.zip", 815_585_330, "4f7e2ccb2866ec5041993c9cf2a952bbed69647b115d0f74da7ce8f4bef82f05"
    ),
    "train2017": _Archive(
        "zips/train2017.zip", 19_336_861_798, "69a8bb58ea5f8f99d24875f21416de2e9ded3178e903f1f7603e283b9e06d929"
    ),
}


def _download_coco(split: str, root: str | os.PathLike[str], *, address: str = _ADDRESS, keep: bool = False) -> None:
    """Fetch a split's images into `root/<split>` and its boxes into `root/annotations/instances_<split>.json`."""
    images = _SPLITS[lookup(split, _SPLITS, "split")]
    check(address.startswith(("http://", "https://")), "address", "http://... or https://...", repr(address))
    _fetch_split(split, Path(root), images, _ANNOTATIONS, address=address, keep=keep)


def _fetch_split(
    split: str,
    root: Path,
    images: _Archive,
    annotations: _Archive,
    *,
    address: str,
    keep: bool,
    pause: float = 1.0,
) -> None:
    """`_download_coco` for any pair of archives; `pause` is in seconds before a failed transfer is tried again."""
    instances = f"annotations/instances_{split}.json"
    try:
        if _is_complete(root, split, instances):
            return
        for archive, members in ((annotations, instances), (images, f"{split}/")):
            brought = root / archive.name
            if brought.exists():
                _verify(brought, archive, f"delete it, and run again to fetch {address}/{archive.path}")
                _unpack_members(brought, root, members)
                continue
            file = _fetch_archive(archive, root / ".download", address=address, pause=pause)
            _unpack_members(file, root, members)
            if keep:
                file.replace(brought)
            else:
                file.unlink()
        with contextlib.suppress(OSError):  # it may hold an unfinished transfer of another split
            (root / ".download").rmdir()
    except OSError as error:
        raise DataError(
            f"{root}: cannot be written ({error.strerror or error}); check the folder and its disk"
        ) from error


def _fetch_archive(archive: _Archive, folder: Path, *, address: str = _ADDRESS, pause: float = 1.0) -> Path:
    """Fetch an archive and verify it; what an earlier run transferred is not fetched again."""
    file = folder / archive.name
    part = folder / f"{archive.name}.part"
    if file.exists():
        return file
    folder.mkdir(parents=True, exist_ok=True)
    needed = 2 * archive.size - _size(part)  # for the archive and for the files in it
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise DataError(
            f"{folder}: expected {needed / 1e9:.1f} GB of free space for {archive.name} and its files, "
            f"got {free / 1e9:.1f} GB; free some space or choose another --root"
        )
    failures = 0
    while (before := _size(part)) < archive.size:
        try:
            _transfer(f"{address.rstrip('/')}/{archive.path}", archive, part)
        except (URLError, HTTPException, ConnectionError, TimeoutError) as error:
            failures = failures + 1 if _size(part) == before else 1
            if failures == _ATTEMPTS:
                reason = getattr(error, "reason", error)
                raise DataError(
                    f"{address}/{archive.path}: transfer failed at {_size(part):,} of {archive.size:,} bytes "
                    f"({reason}); run again to resume, or copy {archive.name} into the data set's folder"
                ) from None
            time.sleep(pause * failures)
    try:
        _verify(part, archive, "it was deleted; run again")
    except DataError:
        part.unlink()
        raise
    part.replace(file)
    return file


def _unpack_members(file: Path, root: Path, members: str) -> None:
    """Unpack members whose names begin with `members`, each atomically; files that are right already are skipped."""
    from tqdm import tqdm

    try:
        with zipfile.ZipFile(file) as archive:
            entries = [
                entry for entry in archive.infolist() if entry.filename.startswith(members) and not entry.is_dir()
            ]
            if not entries:
                raise DataError(f"{file}: expected members {members}*, got none; delete the file and run again")
            for member in tqdm(entries, desc=f"unpacking {file.name}", unit="file", disable=None):
                target = root.joinpath(*_safe_parts(file, member))
                if _is_unpacked(target, member):
                    continue
                target.parent.mkdir(parents=True, exist_ok=True)
                part = target.with_name(f"{target.name}.part")
                with archive.open(member) as source, part.open("wb") as sink:
                    shutil.copyfileobj(source, sink, _CHUNK)
                part.replace(target)
    except zipfile.BadZipFile as error:
        raise DataError(f"{file}: damaged zip file ({error}); delete it and run again") from None


def _safe_parts(file: Path, member: zipfile.ZipInfo) -> tuple[str, ...]:
    """Return the parts of a member's path; raises `DataError` for names and links that lead out of the folder."""
    path = PurePosixPath(member.filename)
    if ".." in path.parts or path.is_absolute() or "\\" in member.filename or ":" in member.filename:
        raise DataError(f"{file}: holds a file with the unsafe name {member.filename!r}; delete it")
    if stat.S_ISLNK(member.external_attr >> 16):
        raise DataError(f"{file}: holds the link {member.filename!r}; delete it")
    return path.parts


def _is_unpacked(target: Path, member: zipfile.ZipInfo) -> bool:
    """Tell whether a file has the size and the checksum of a member."""
    is_of_size = target.is_file() and target.stat().st_size == member.file_size
    return is_of_size and zlib.crc32(target.read_bytes()) == member.CRC


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `python -m train.coco`."""
    parser = argparse.ArgumentParser(
        prog="python -m train.coco",
        description="Fetch the official COCO 2017 photographs and their boxes. An interrupted run is resumed by "
        "the same command; files that are already complete are not fetched again.",
        epilog="Without a network, copy the zip files from another machine into DIR and run the same command.",
    )
    parser.add_argument(
        "split", choices=sorted(_SPLITS), help="val2017: 5,000 images, 1.1 GB; train2017: 118,287, 20 GB"
    )
    parser.add_argument("--root", required=True, metavar="DIR", help="folder of the data set; created if missing")
    parser.add_argument("--address", default=_ADDRESS, metavar="URL", help="server or mirror (default: %(default)s)")
    parser.add_argument("--keep", action="store_true", help="keep the zip files that were fetched")
    options = parser.parse_args(arguments)
    try:
        _download_coco(options.split, options.root, address=options.address, keep=options.keep)
    except SemfovError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; run the same command to resume", file=sys.stderr)
        return 130
    root = Path(options.root)
    print(f"data.root: {root / options.split}")
    print(f"data.annotations: {root / 'annotations' / f'instances_{options.split}.json'}")
    return 0


def _transfer(url: str, archive: _Archive, part: Path) -> None:
    """Append the missing bytes to `part`; raise `ConnectionError` where the server stops early."""
    from tqdm import tqdm

    start = _size(part)
    try:
        response: HTTPResponse = urlopen(Request(url, headers={"Range": f"bytes={start}-"}), timeout=_TIMEOUT)
    except HTTPError as error:
        error.close()
        if error.code >= 500:
            raise
        raise DataError(f"{url}: the server answers {error.code} {error.reason}; check the address") from None
    with response:
        if response.status != 206:  # the server does not support ranges and sends the whole file
            start = 0
        length = response.headers.get("Content-Length")
        if length is not None and start + int(length) != archive.size:
            raise DataError(
                f"{url}: expected {archive.size:,} bytes, the server has {start + int(length):,}; check the address"
            )
        bar = tqdm(
            total=archive.size,
            initial=start,
            desc=archive.name,
            unit="B",
            unit_scale=True,
            unit_divisor=1024,
            disable=None,
        )
        with bar, part.open("r+b" if start else "wb") as sink:
            sink.seek(start)
            while chunk := _read(response):
                sink.write(chunk)
                bar.update(len(chunk))
                if sink.tell() > archive.size:
                    sink.truncate(0)
                    raise DataError(f"{url}: expected {archive.size:,} bytes, the server sends more; check the address")
    if _size(part) < archive.size:
        raise ConnectionError("the connection closed early")


def _read(response: HTTPResponse) -> bytes:
    try:
        return response.read(_CHUNK)
    except OSError as error:  # a network error; errors of the disk are not converted
        raise ConnectionError(error) from error


def _verify(file: Path, archive: _Archive, remedy: str) -> None:
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    if digest != archive.sha256:
        raise DataError(f"{file}: expected sha256 {archive.sha256}, got {digest}; {remedy}")


def _size(file: Path) -> int:
    return file.stat().st_size if file.exists() else 0


def _is_complete(root: Path, split: str, instances: str) -> bool:
    """Tell whether all images of the annotations are there."""
    try:
        images = json.loads((root / instances).read_bytes())["images"]
        return {image["file_name"] for image in images} <= set(os.listdir(root / split))
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (ValueError, KeyError, TypeError):  # not the official file, so it will be replaced by the official one
        return False


if __name__ == "__main__":
    sys.exit(main())
