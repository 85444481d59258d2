"""One writer a results folder: the lock names its holder, ends with it, and has a stand-in where there are no locks."""

from __future__ import annotations

import errno
import os
import platform
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from vecenv_eval.store import ResultStore, StoreError, lock
from vecenv_eval.store.lock import writing

HOLDER = """
import fcntl, errno, sys
from pathlib import Path
from vecenv_eval.store import lock
if sys.argv[2] == "without":
    own = fcntl.lockf
    def lockf(handle, *rest):
        if Path(f"/proc/self/fd/{handle}").resolve().name == ".lock":
            raise OSError(errno.ENOLCK, "no locks")
        return own(handle, *rest)
    fcntl.lockf = lockf
with lock.writing(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
HELD = re.compile(r"is in use: process (\d+) on (\S+) since (\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\+00:00) writes to it$")


@contextmanager
def holder(folder: Path, locks: str = "with") -> Iterator[subprocess.Popen[bytes]]:
    """Another process that holds the folder, on a file system with or without locks."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command, pipe = [sys.executable, "-c", HOLDER, str(folder), locks], subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"held\n"
        try:
            yield process
        finally:
            process.kill()


@pytest.fixture
def no_locks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A file system without locks, for the lock's own file."""
    import fcntl

    own = fcntl.lockf

    def lockf(handle: int, *rest: int) -> None:
        if Path(f"/proc/self/fd/{handle}").resolve().name == lock.LOCK:
            raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))
        own(handle, *rest)

    monkeypatch.setattr(fcntl, "lockf", lockf)


def refused(folder: Path) -> str:
    with pytest.raises(StoreError) as raised, writing(folder):
        pass
    return str(raised.value)


def test_the_holder_is_named_by_process_host_and_time(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        found = HELD.search(refused(tmp_path))
        assert found is not None
        assert found.groups()[:2] == (str(process.pid), platform.node())
    with writing(tmp_path):  # it ended, and so did its lock
        pass


def test_a_lock_ends_with_a_process_that_is_killed(tmp_path: Path) -> None:
    with holder(tmp_path) as process:
        process.send_signal(signal.SIGKILL)
        process.wait()
        with writing(tmp_path):
            assert f"process {os.getpid()} on" in (tmp_path / lock.LOCK).read_text()


def test_a_thread_does_not_write_beside_another_one(tmp_path: Path) -> None:
    said: list[str] = []
    with writing(tmp_path), writing(tmp_path):  # the same thread may
        thread = threading.Thread(target=lambda: said.append(refused(tmp_path)))
        thread.start()
        thread.join()
        with writing(tmp_path):
            pass
    assert said == [f"{tmp_path} is in use: another thread of this process writes to it"]
    thread = threading.Thread(target=lambda: writing(tmp_path).__enter__())
    thread.start()
    thread.join()


def test_a_folder_is_begun_by_one_process(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with holder(folder), pytest.raises(StoreError, match="is in use: process"):
        ResultStore.create(folder, {})
    assert ResultStore.create(folder, {}).records() == {}


def test_what_a_lock_says_is_one_line_whoever_wrote_it(tmp_path: Path) -> None:
    with holder(tmp_path):
        (tmp_path / lock.LOCK).write_bytes(b"\x1b[31m process \xff\x00 on moon\nerror: second line\n" * 100)
        said = refused(tmp_path)
    assert said == f"{tmp_path} is in use: ?[31m process �? on moon writes to it"


@pytest.mark.usefixtures("no_locks")
def test_without_locks_other_processes_of_the_machine_are_kept_out(tmp_path: Path) -> None:
    with holder(tmp_path, "without") as process:
        found = HELD.search(refused(tmp_path))
        assert found is not None
        assert int(found[1]) == process.pid
        process.send_signal(signal.SIGKILL)  # which leaves its file
        process.wait()
        assert (tmp_path / lock.HOST).exists()
        with writing(tmp_path):
            assert f"process {os.getpid()} on {platform.node()}" in (tmp_path / lock.HOST).read_text()
    assert not (tmp_path / lock.HOST).exists()


@pytest.mark.usefixtures("no_locks")
def test_without_locks_another_machine_is_kept_out(tmp_path: Path) -> None:
    other = "process 7 on elsewhere since 2026-01-02T03:04:05+00:00"
    (tmp_path / lock.HOST).write_text(f"{other}\n")
    said = refused(tmp_path)
    assert said == (f"{tmp_path} is in use: {other} writes to it; if that runs no more, remove {tmp_path / lock.HOST}")
    (tmp_path / lock.HOST).unlink()
    with writing(tmp_path):
        pass
