"""Files that are whole after a crash or a power cut: replaced in one step, or appended to and synced.

A folder may be a stranger's: nothing is written through a link, which could lead to any file of this machine, and
nothing is read from a pipe or a device, which could have no end (:func:`open_regular`).

:func:`read_json` reads what may be damaged or a stranger's, with limits on its size, depth and numbers.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from vecenv_eval.store.record import LARGEST, StoreError, unicode

# Bytes of a JSON file, and levels of objects and lists in each other; ours have less than 1 MB and 10 levels.
MOST_BYTES, MOST_LEVELS = 1 << 28, 64


def read_json(path: Path) -> dict[str, Any]:
    """The JSON object in a file.

    Raises:
        OSError: the file cannot be read.
        StoreError: it is larger than `MOST_BYTES`, is no JSON object, or holds what `parse_json` refuses.
    """
    if (size := path.stat().st_size) > MOST_BYTES:
        raise StoreError(f"{path} cannot be read: it has {size:,} bytes, more than {MOST_BYTES:,}")
    try:
        content = parse_json(read_regular(path))
    except ValueError as error:
        raise StoreError(f"{path} cannot be read: {error}") from None
    if not isinstance(content, dict):
        raise StoreError(f"{path} cannot be read: it holds no JSON object")
    return content


def parse_json(text: bytes) -> Any:
    """Plain values from JSON in UTF-8; texts have a form in UTF-8, which JSON does not promise.

    Raises:
        ValueError: it is none, its levels are too deep, or it holds a number that is too large.
    """
    try:
        value = json.loads(text.decode("utf-8"))
    except RecursionError:
        raise ValueError(f"more than {MOST_LEVELS} levels of JSON") from None
    return _checked(value, MOST_LEVELS)


def _checked(value: Any, levels: int) -> Any:
    """The value; depth is refused, and numbers that nothing else could store."""
    if levels < 0:
        raise ValueError(f"more than {MOST_LEVELS} levels of JSON")
    if isinstance(value, dict):
        return {unicode(name): _checked(each, levels - 1) for name, each in value.items()}
    if isinstance(value, list):
        return [_checked(each, levels - 1) for each in value]
    if isinstance(value, int) and abs(value) > LARGEST:
        raise ValueError(f"a whole number has {len(str(abs(value)))} digits, more than can be stored")
    return unicode(value) if isinstance(value, str) else value


def open_regular(path: Path, flags: int) -> int:
    """A handle on a regular file, without waiting; what is opened to be written is not opened through a link.

    Args:
        path: the file.
        flags: of ``os.open``.

    Raises:
        OSError: it cannot be opened, or is a folder.
        StoreError: it is a link to be written through, a pipe or a device.
    """
    writes = bool(flags & (os.O_WRONLY | os.O_RDWR))
    if writes and path.is_symlink():
        raise StoreError(f"{path} is a link, through which nothing is written: put the file itself there")
    flags |= getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    try:
        handle = os.open(path, flags | (getattr(os, "O_NOFOLLOW", 0) if writes else 0), 0o666)
    except OSError as error:
        if error.errno == errno.ENXIO:  # a pipe that nobody reads
            raise StoreError(f"{path} is not a regular file") from None
        raise
    kind = os.fstat(handle).st_mode
    if stat.S_ISREG(kind):
        return handle
    os.close(handle)
    if stat.S_ISDIR(kind):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    raise StoreError(f"{path} is not a regular file")


def read_regular(path: Path, most: int = -1) -> bytes:
    """The content of a regular file, of at most so many bytes; raises as `open_regular`."""
    with os.fdopen(open_regular(path, os.O_RDONLY), "rb") as file:
        return file.read(most)


def append_text(path: Path, text: str) -> None:
    """Append to a file, or make it, and wait until it is on the disk."""
    new = not path.exists()
    handle = open_regular(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    with naming(path), os.fdopen(handle, "a", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    if new:
        sync_folder(path.parent)


def replace_text(path: Path, text: str) -> None:
    """Replace a text file in one step and wait until it is on the disk."""
    replace_bytes(path, text.encode())


def replace_bytes(path: Path, content: bytes) -> None:
    """Replace a file in one step and wait until it is on the disk; when that fails, nothing new is left there."""
    temporary = path.with_name(path.name + ".tmp")
    try:
        if temporary.is_symlink():  # not ours
            temporary.unlink()
        with naming(path), os.fdopen(open_regular(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Errors of the system inside name this file, where they name none: those of writing to an open file do not."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        raise


def sync_folder(folder: Path) -> None:
    """Wait until the names of a folder's files are on the disk, where the system can."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    except OSError:
        pass  # some network file systems cannot sync a folder
    finally:
        os.close(handle)
