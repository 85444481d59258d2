"""The regular files of zip and tar archives, found by file name and size and never unpacked to a path of the archive.

In: an archive file (.zip, .tar, .tar.gz, .tar.xz, .tar.bz2). Out: ``Members``; the caller copies their content to a
path that it chooses. Links, devices and folders are left out.
"""

from __future__ import annotations

import bz2
import contextlib
import errno
import gzip
import itertools
import lzma
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO

from vecenv.simpler.assets.errors import PullError, reason

CHUNK = 1 << 16
# Limits of what an archive may hold: bytes of a decompressed tar, in all, and beyond the first ones by how much it may
# be larger than the archive (meshes and images: at most ten times); and entries.
MAX_PLAIN, _FREE, _RATIO, MAX_ENTRIES = 1 << 34, 1 << 26, 100, 1 << 17
_SUFFIXES = (".zip", ".tar", ".tar.gz", ".tgz", ".tar.xz", ".tar.bz2")
_DECOMPRESSORS: dict[bytes, Callable[[Path], IO[bytes]]] = {
    b"\x1f\x8b": gzip.open,  # type: ignore[dict-item]
    b"\xfd7zXZ\x00": lzma.open,
    b"BZh": bz2.open,
}
DAMAGE = (zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, RuntimeError, OSError)
"""What the standard library raises on a damaged, encrypted or unknown archive."""


def is_archive(name: str) -> bool:
    """Whether a file name ends like an archive's."""
    return name.endswith(_SUFFIXES)


def copy_at_most(stream: IO[bytes], to: IO[bytes], most: int) -> None:
    """Copy a stream of at most so many bytes.

    Raises:
        OSError: it has more, for example because a small archive decompresses to endless zeros.
    """
    size = 0
    while chunk := stream.read(CHUNK):
        size += len(chunk)
        if size > most:
            raise OSError(errno.EFBIG, f"decompresses to more than {most} bytes")
        to.write(chunk)


@dataclass(frozen=True)
class Member:
    """A regular file of an archive: its size in bytes, and ``open``, which returns its content as a stream."""

    size: int
    open: Callable[[], IO[bytes]]


class Members:
    """The regular files of an archive, by file name without folders."""

    def __init__(self, files: Iterable[tuple[str, Member]]) -> None:
        self._by_name: dict[str, list[Member]] = {}
        for path, member in files:
            self._by_name.setdefault(PurePosixPath(path).name, []).append(member)

    def named(self, name: str, size: int | None, max_bytes: int) -> list[Member]:
        """Members with a file name, of this size where it is known, else of at most ``max_bytes``."""
        members = self._by_name.get(name, ())
        return [member for member in members if (member.size <= max_bytes if size is None else member.size == size)]


@contextlib.contextmanager
def open_archive(path: Path, name: str, scratch: Path) -> Iterator[Members]:
    """The files of a zip or tar archive; a compressed tar is decompressed into ``scratch`` meanwhile.

    Args:
        path: the archive.
        name: what error messages call it.
        scratch: a folder.

    Raises:
        PullError: it is neither, or damaged.
    """
    with contextlib.ExitStack() as stack:
        try:
            if zipfile.is_zipfile(path):
                members = _zip_members(stack.enter_context(zipfile.ZipFile(path)))
            else:
                plain = stack.enter_context(_decompressed(path, scratch))
                members = _tar_members(stack.enter_context(tarfile.open(fileobj=plain, mode="r:")))
        except DAMAGE as error:
            raise PullError(f"{name} is not an archive that can be read: {reason(error)}") from error
        yield members


@contextlib.contextmanager
def _decompressed(path: Path, scratch: Path) -> Iterator[IO[bytes]]:
    with path.open("rb") as file:
        start = file.read(8)
        opener = next((opener for magic, opener in _DECOMPRESSORS.items() if start.startswith(magic)), None)
        if opener is None:
            file.seek(0)
            yield file
            return
    with tempfile.TemporaryFile(dir=scratch) as plain:
        with opener(path) as stream:
            copy_at_most(stream, plain, min(MAX_PLAIN, _FREE + _RATIO * path.stat().st_size))
        plain.seek(0)
        yield plain


def _zip_members(archive: zipfile.ZipFile) -> Members:
    def opener(info: zipfile.ZipInfo) -> Callable[[], IO[bytes]]:
        return lambda: archive.open(info)

    if len(archive.infolist()) > MAX_ENTRIES:
        raise zipfile.BadZipFile(f"more than {MAX_ENTRIES} entries")
    infos = [info for info in archive.infolist() if not info.is_dir()]
    return Members((info.filename, Member(info.file_size, opener(info))) for info in infos)


def _tar_members(archive: tarfile.TarFile) -> Members:
    def opener(info: tarfile.TarInfo) -> Callable[[], IO[bytes]]:
        def opened() -> IO[bytes]:
            stream = archive.extractfile(info)
            assert stream is not None  # only None for what is not a regular file
            return stream

        return opened

    listed = list(itertools.islice(archive, MAX_ENTRIES + 1))
    if len(listed) > MAX_ENTRIES:
        raise tarfile.TarError(f"more than {MAX_ENTRIES} entries")
    return Members((info.name, Member(info.size, opener(info))) for info in listed if info.isfile())
