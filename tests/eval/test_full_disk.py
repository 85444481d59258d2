"""A disk that is full, or a folder that may only be read: one line, exit status 2, and nothing is lost."""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from support import recorded_world as world
from support.results_folders import some_records, write_results
from typer.testing import CliRunner
from vecenv_eval import runner
from vecenv_eval.store import ResultStore

from vecenv.cli import build_app, main

pytest.importorskip("pyarrow")
pytest.importorskip("av")

POLICY = f"{world.UnlikelyPolicy.__module__}:{world.UnlikelyPolicy.__name__}"
SETTINGS = f"--suite {world.SUITE} --policy {POLICY} --tasks 0-1 --num-envs 3 --quiet"
RECORDERS = {
    "states": ["--record-states"],
    "lerobot": ["--record-lerobot"],
    "video": ["--video", "all"],
    "all": ["--record-states", "--record-lerobot", "--video", "all"],
}


@dataclass(frozen=True)
class Done:
    """How a command ended in a fork."""

    returncode: int
    stderr: str


def evaluate(folder: Path, *options: str, limit: int = 0) -> Done:
    """``vecenv eval`` of the fake suite in a fork, where no file may grow beyond so many bytes."""
    with tempfile.TemporaryFile() as said:
        pid = os.fork()
        if pid == 0:
            status = 3
            try:
                os.dup2(said.fileno(), 2)
                sys.stderr = os.fdopen(2, "w")
                runner.vecenv_simulator = lambda: world.RecordedWorld().simulator
                if limit:
                    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
                sys.argv = ["vecenv", "eval", *SETTINGS.split(), "--out", str(folder), *options]
                main()
            except SystemExit as exit:
                status = exit.code if isinstance(exit.code, int) else 0
            finally:
                sys.stderr.flush()
                os._exit(status)
        _, ended = os.waitpid(pid, 0)
        said.seek(0)
        return Done(os.waitstatus_to_exitcode(ended), said.read().decode())


def check_refused(done: Done, folder: Path) -> None:
    assert done.returncode == 2, (done.returncode, done.stderr)
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert "cannot be written" in line
    assert str(folder) in line


@pytest.mark.parametrize(
    ("recorder", "limit"), [("states", 30_000), ("lerobot", 4_000), ("video", 4_000), ("all", 30_000)]
)
def test_a_file_that_cannot_grow_costs_no_verdict_and_no_recording(tmp_path: Path, recorder: str, limit: int) -> None:
    folder, options = tmp_path / "run", RECORDERS[recorder]
    done = evaluate(folder, *options, limit=limit)
    check_refused(done, folder)
    kept = world.verdicts(folder)
    assert len(kept) < 10 or recorder == "lerobot"  # whose files are written after the last verdict
    check_recorded(folder, recorder, everything=False)
    assert evaluate(folder, *options).returncode == 0
    assert len(world.verdicts(folder)) == 10
    assert kept.items() <= world.verdicts(folder).items()
    check_recorded(folder, recorder, everything=True)


def check_recorded(folder: Path, recorder: str, everything: bool) -> None:
    """What has a verdict has its recordings; at the end, nothing else has."""
    done = world.verdicts(folder)
    found: list[Callable[[], dict]] = []
    if recorder in ("states", "all"):
        found.append(lambda: world.recordings(folder))
    if recorder in ("lerobot", "all"):
        found.append(lambda: dict([*world.dataset(folder), *world.waiting(folder)]))
    for each in found:
        assert done.items() <= each().items()
        assert not everything or each() == done
    if recorder in ("video", "all"):
        assert all((folder / "videos" / f"{world.SUITE}_{k.task}_{k.episode}.mp4").is_file() for k in done)


@contextmanager
def small_disk(place: Path, size: str) -> Iterator[Callable[[str], object]]:
    """A file system of so many bytes; gives what changes its size. Only root may mount one."""
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    if os.name != "posix" or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("a file system cannot be mounted here")
    try:
        yield lambda options: subprocess.run(["mount", "-o", f"remount,{options}", str(place)], check=True)
    finally:
        subprocess.run(["umount", "-l", str(place)], check=True)


@pytest.mark.parametrize("store", ["jsonl", "sqlite"])
def test_a_full_disk(tmp_path: Path, store: str) -> None:
    """The size at which it is full differs, so that another file is the one that does not fit."""
    folder = tmp_path / "disk" / "run"
    options = ["--store", store, *RECORDERS["all"]]
    with small_disk(tmp_path / "disk", "60k") as resize:
        check_refused(evaluate(folder, *options), tmp_path / "disk")
        for size in ("120k", "180k"):
            resize(f"size={size}")
            kept = world.verdicts(folder)
            done = evaluate(folder, *options)
            assert kept.items() <= world.verdicts(folder).items()
            check_recorded(folder, "all", everything=False)
            if done.returncode:
                check_refused(done, tmp_path / "disk")
        resize("size=4m")
        done = evaluate(folder, *options)
        assert done.returncode == 0, done.stderr
        assert len(world.verdicts(folder)) == 10
        check_recorded(folder, "all", everything=True)


@pytest.mark.parametrize("store", ["jsonl", "sqlite"])
def test_a_folder_that_may_only_be_read_can_be_read(tmp_path: Path, store: str) -> None:
    """Also one whose process was killed, which left a log beside its database."""
    made = tmp_path / "made"
    config = {"suite": "libero_goal", "policy": "zero", "store": store}
    store_of = write_results(made, some_records(lambda task, episode: True), config=config)
    with small_disk(tmp_path / "disk", "4m") as remount:
        folder = tmp_path / "disk" / "run"
        shutil.copytree(store_of, folder, ignore=shutil.ignore_patterns("*-shm"))
        before = ResultStore(folder).records()
        remount("ro")
        assert ResultStore.open(folder).records() == before
        done = evaluate(folder)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1
        read = CliRunner().invoke(build_app(), ["report", str(folder), "--format", "csv"])
        assert read.exit_code == 0, read.output
        page = CliRunner().invoke(build_app(), ["report", str(folder)])
        assert page.exit_code == 2
        assert f"{folder}/report.html cannot be written: Read-only file system" in page.stderr
        remount("rw")
