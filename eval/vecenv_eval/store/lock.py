"""One process at a time writes to a results folder; any number may read it.

The lock is one of the operating system's (POSIX record locks, which also work over NFS) on the file ``.lock``. It ends
with the process, however that ends, so that nothing has to be cleaned up after a crash. The file says who holds it:
process, host and since when.

Where a file system has no locks, two other things stand in for it: such a lock on a file of this machine, which keeps
out its other processes, and the file ``.lock.host``, which keeps out other machines. That one outlives a crash: the
machine that made it takes it over, another one is told to remove it.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path

from vecenv_eval.store.files import open_regular, read_regular
from vecenv_eval.store.record import StoreError

LOCK, HOST = ".lock", ".lock.host"
_IN_USE = (errno.EACCES, errno.EAGAIN)
# Bytes of the text in a lock's file.
_MOST = 400
# Folders that this process has locked, and the process and thread that did. A record lock belongs to a process, and
# ends when any handle on the file closes.
_HELD: dict[Path, tuple[int, int]] = {}
_GUARD = threading.Lock()


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """Be the only one that writes to a results folder; inside another such context of the thread nothing changes.

    Raises:
        StoreError: another process or thread writes to it, or this one may not; the message names the holder.
    """
    key, me = folder.resolve(), (os.getpid(), threading.get_ident())
    with _GUARD:
        holder = _HELD.get(key)
        if holder is None or holder[0] != me[0]:  # a fork's locks are its parent's
            _HELD[key], holder = me, None
    if holder == me:
        yield
        return
    if holder is not None:
        raise StoreError(f"{folder} is in use: another thread of this process writes to it")
    with ExitStack() as stack:
        stack.callback(_HELD.pop, key, None)
        try:
            handle = open_regular(folder / LOCK, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            raise StoreError(f"{folder} cannot be written: {error.strerror}") from None
        stack.callback(os.close, handle)
        _lock(handle, folder, stack)
        yield


def _lock(handle: int, folder: Path, stack: ExitStack) -> None:
    """Lock the file, or what stands in for it; the stack lets go."""
    if _locked(handle, folder):
        _write(handle)
        return
    name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()[:32]
    place = Path(tempfile.gettempdir()) / f"vecenv-{os.getuid() if hasattr(os, 'getuid') else 0}-{name}.lock"
    try:
        local = os.open(place, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
    except OSError as error:
        raise StoreError(f"{folder} cannot be locked: {place}: {error.strerror}") from None
    stack.callback(os.close, local)
    _locked(local, folder)
    _write(local)
    _mark_host(folder)
    stack.callback((folder / HOST).unlink, missing_ok=True)


def _locked(handle: int, folder: Path) -> bool:
    """Take a record lock; False where there are none.

    Raises:
        StoreError: another process has it.
    """
    try:
        import fcntl
    except ImportError:  # not on POSIX
        return False
    try:
        fcntl.lockf(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _IN_USE:
            holder = _text(os.pread(handle, _MOST, 0)) or "another process"
            raise StoreError(f"{folder} is in use: {holder} writes to it") from None
        return False
    return True


def _mark_host(folder: Path) -> None:
    """Keep other machines out of a folder, whose other processes on this one are kept out already.

    Raises:
        StoreError: another machine has it.
    """
    path = folder / HOST
    try:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666)
    except FileExistsError:
        holder = _text(read_regular(path, _MOST))
        if f" on {platform.node()} since " not in holder:
            raise StoreError(
                f"{folder} is in use: {holder or 'another machine'} writes to it; if that runs no more, remove {path}"
            ) from None
        handle = open_regular(path, os.O_RDWR)
    except OSError as error:
        raise StoreError(f"{path} cannot be written: {error.strerror}") from None
    try:
        _write(handle)
    finally:
        os.close(handle)


def _write(handle: int) -> None:
    """Say who has the lock; where there is no room for it, nobody is named."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        os.ftruncate(handle, 0)
        os.pwrite(handle, f"process {os.getpid()} on {platform.node()} since {now}\n".encode(), 0)
    except OSError:
        pass


def _text(content: bytes) -> str:
    """One line of a lock's file, which anybody may have written."""
    text = content.decode(errors="replace").split("\n")[0]
    return "".join(each if each.isprintable() else "?" for each in text).strip()
