"""One process at a time writes to a results folder; any number may read it.

The lock is one of the operating system's (POSIX record locks, which also work over NFS) on the file ``.lock``. It ends
with the process, however that ends, so that nothing has to be cleaned up after a crash.
"""

from __future__ import annotations

import errno
import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from vecenv_eval.store.record import StoreError

LOCK = ".lock"
_IN_USE = (errno.EACCES, errno.EAGAIN)
# Folders that this process has locked. A record lock belongs to a process, and ends when any handle on the file closes.
_HELD: set[Path] = set()


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Be the only process that writes to a results folder; inside another such context nothing changes.

    Where the file system has no locks, nothing is locked.

    Raises:
        StoreError: another process writes to it, or this one may not.
    """
    key = folder.resolve()
    if key in _HELD:
        yield
        return
    try:
        handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise StoreError(f"{folder} cannot be written: {error.strerror}") from None
    try:
        _lock(handle, folder)
        _HELD.add(key)
        yield
    finally:
        _HELD.discard(key)
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # not on POSIX
        return
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _IN_USE:
            holder = os.pread(handle, 200, 0).decode(errors="replace").strip() or "another process"
            raise StoreError(f"{folder} is in use: {holder} writes to it") from None
        return  # a file system without locks
    os.ftruncate(handle, 0)
    os.pwrite(handle, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)
