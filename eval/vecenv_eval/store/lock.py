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
_HELD = (errno.EACCES, errno.EAGAIN)


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Be the only process that writes to a results folder.

    Where the file system has no locks, nothing is locked.

    Raises:
        StoreError: another process writes to it.
    """
    try:
        import fcntl
    except ImportError:  # not on POSIX
        yield
        return
    handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _HELD:
                holder = os.pread(handle, 200, 0).decode(errors="replace").strip() or "another process"
                raise StoreError(f"{folder} is in use: {holder} writes to it") from None
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {platform.node()}\n".encode(), 0)
        yield
    finally:
        os.close(handle)
