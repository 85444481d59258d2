"""HDF5 files are read in a process of their own: one that hangs, crashes or fills the memory costs that file alone."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support.demo_files import FIXTURES, mjcf, replace, some_rollout, write
from typer.testing import CliRunner
from vecenv_eval.demos import reader
from vecenv_eval.demos.files import read_files
from vecenv_eval.demos.hdf5 import DemoError
from vecenv_eval.demos.outcomes import Outcome, ReplayReport
from vecenv_eval.demos.read import read_demos, read_here
from vecenv_eval.demos.reader import READER, Reader

from vecenv.cli import build_app
from vecenv.libero.tasks.suites import task as task_spec

SPEC = task_spec("libero_goal", 3)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "some.hdf5", SPEC, [some_rollout(SPEC), some_rollout(SPEC, ticks=6, success=False)])


def edit(path: Path, change: Any) -> None:
    with h5py.File(path, "r+") as file:
        change(file["data"])


def test_the_answer_is_what_this_process_would_have_read(path: Path) -> None:
    edit(path, lambda data: data["demo_1"].attrs.pop("model_file"))
    for ours, theirs in zip(read_demos(path)[0], read_here(path)[0], strict=True):
        for name in ("path", "name", "suite", "task", "success", "stand_ins", "second_half"):
            assert getattr(ours, name) == getattr(theirs, name)
        np.testing.assert_array_equal(ours.actions, theirs.actions)
        np.testing.assert_array_equal(ours.start.state, theirs.start.state)  # pyright: ignore[reportAttributeAccessIssue]
        assert str(ours.start.fixtures) == str(theirs.start.fixtures)  # pyright: ignore[reportAttributeAccessIssue]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a file that never opens")
def test_a_file_that_takes_too_long_is_given_up_and_the_next_is_read(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    READER.ask(path, "check")
    monkeypatch.setattr(reader, "DEADLINE_S", 0.5)
    os.mkfifo(path.with_name("endless.hdf5"))
    began = time.monotonic()
    with pytest.raises(DemoError, match=r"endless\.hdf5: not read within 0\.5 s: it is damaged, or made to take long"):
        read_demos(path.with_name("endless.hdf5"))
    assert time.monotonic() - began < 10
    monkeypatch.setattr(reader, "DEADLINE_S", 60.0)
    assert len(read_demos(path)[0]) == 2


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs a file that never opens")
def test_a_file_that_crashes_the_library_is_named(path: Path) -> None:
    """The signal comes from here, because which files crash depends on the library's version."""
    own = Reader()
    own.ask(path, "check")
    assert own._process is not None
    process = own._process
    os.mkfifo(path.with_name("crash.hdf5"))
    timer = threading.Timer(0.2, lambda: process.send_signal(signal.SIGSEGV))
    timer.start()
    with pytest.raises(DemoError, match=r"crash\.hdf5: reading it crashed the HDF5 library \(SIGSEGV\)"):
        own.ask(path.with_name("crash.hdf5"), "check")
    own.ask(path, "check")
    assert own._process is not process
    own.close()


def test_a_request_that_is_stopped_leaves_no_answer_for_the_next(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = Reader()

    def stop(*_: Any) -> Any:
        monkeypatch.undo()
        raise KeyboardInterrupt

    own.ask(path, "check")
    monkeypatch.setattr(reader, "_receive", stop)
    with pytest.raises(KeyboardInterrupt):
        own.ask(path, "check")
    assert len(own.ask(path, "read", suite=None, task=None).content["demos"]) == 2
    own.close()


def hard_link(data: Any) -> None:
    del data["demo_0"]
    data["demo_0"] = data["demo_1"]


def many(data: Any) -> None:
    for number in range(20_001):
        data.create_group(f"x{number}")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (hard_link, "'demo_0' has 2 links to it, which no group of a demonstration has"),
        (lambda data: data["demo_0"].__setitem__("again", data["demo_0/actions"]), "'actions' has 2 links to it"),
        (
            lambda data: data["demo_0"].attrs.modify("init_state", np.full(79, 1e300)),
            "init_state: holds 1e+300, more than 1e+06",
        ),
        (
            lambda data: data["demo_0"].attrs.modify("model_file", mjcf(FIXTURES).replace("0.905", "1e308")),
            "more than 100 m from the origin",
        ),
        (
            lambda data: replace(data["demo_0"], "actions", np.zeros((100_001, 7), "f4")),
            "actions: expected [T, 7] with T from 1 to 100,000",
        ),
        (lambda data: replace(data["demo_0"], "actions", np.zeros((4, 7), "S9")), "actions: expected numbers"),
        (
            lambda data: data["demo_0"].attrs.create("make", '{"seed": ' + "9" * 5000 + "}"),
            "attribute make: not JSON",
        ),
    ],
)
def test_what_is_too_much_for_one_demonstration_costs_that_one(path: Path, change: Any, says: str) -> None:
    edit(path, change)
    demos, bad = read_demos(path)
    assert [each.name for each in bad if says in each.reason] == ["demo_0"], bad
    assert len(demos) == 2 - len(bad)


def test_an_attribute_is_not_read_before_its_size_is_known(path: Path) -> None:
    with h5py.File(path, "r+", libver="latest") as file:
        demo: Any = file.create_group("data/demo_2")
        demo["actions"] = np.zeros((4, 7))
        demo.attrs["init_state"] = SPEC.init_states()[0]
        demo.attrs["success"] = np.zeros(1 << 23)
    demos, (bad,) = read_demos(path)
    assert len(demos) == 2
    assert "attribute success: 67,108,864 bytes, more than 33,554,432" in bad.reason


def test_what_is_too_much_for_a_file(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vecenv_eval.demos.read.MOST_TICKS_OF_A_FILE", 3)
    demos, bad = read_here(path)
    assert ([demo.name for demo in demos], [each.name for each in bad]) == (["demo_0"], ["demo_1"])
    edit(path, many)
    with pytest.raises(DemoError, match=r"its group 'data' has 20,003 members, more than 20,000"):
        read_demos(path)


def test_what_is_too_much_for_all_files(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vecenv_eval.demos.files.MOST_TICKS", 10)
    demos, (bad,) = read_files([path, path.with_name("more.hdf5")])
    assert len(demos) == 2
    assert bad.reason == "the files before it have more than 10 actions: replay fewer at once"


def test_one_bad_file_does_not_end_the_replay_of_the_others(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from vecenv_eval.demos import replay

    def agree(demos: Any, *_: Any, **__: Any) -> ReplayReport:
        fields = {"replayed": True, "ticks": 4, "qpos_error": None, "qvel_error": None}
        made = [
            Outcome(path=d.path, name=d.name, suite=d.suite, task=d.task, recorded=True, length=len(d), **fields)
            for d in demos
        ]
        return ReplayReport(outcomes=tuple(made), problems=())

    monkeypatch.setattr(replay, "replay", agree)
    path.with_name("cut.hdf5").write_bytes(path.read_bytes()[:3000])
    path.with_name("not.hdf5").write_text("hello")
    done = CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["replay", str(path.parent)])
    assert "cut.hdf5: not a readable HDF5 file" in done.stdout
    assert "not.hdf5: not a readable HDF5 file" in done.stdout
    assert "verdicts agree: 2/2" in done.stdout
    assert done.exit_code == 1
