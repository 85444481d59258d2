"""Experiment trackers: what they are told, that it can be read back, and that they never cost an episode."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from support.fakes import SUITE, FakeWorld
from typer.testing import CliRunner
from vecenv_eval import runner, trackers
from vecenv_eval.campaign import Campaign
from vecenv_eval.config import TRACKERS, ConfigError, EvalConfig
from vecenv_eval.results import begin, resume
from vecenv_eval.runner import Evaluation
from vecenv_eval.trackers import TrackedRun, Tracking
from vecenv_eval.video.episodes import video_path

from vecenv.cli import build_app
from vecenv.util import extras


class Notes:
    """A tracker that keeps what it is told; it raises in the method named ``broken``."""

    made: list[Notes]

    def __init__(self, broken: str = "") -> None:
        self.broken = broken
        self.runs: list[TrackedRun] = []
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.videos: list[tuple[str, Path]] = []
        self.final: dict[str, float] = {}
        self.closed: list[bool] = []

    def _called(self, name: str) -> None:
        if name == self.broken:
            raise ConnectionError(f"no network in {name}")

    def start(self, run: TrackedRun) -> None:
        self._called("start")
        self.runs.append(run)

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._called("log")
        self.logged.append((step, dict(values)))

    def video(self, name: str, path: Path, step: int) -> None:
        self._called("video")
        self.videos.append((name, path))

    def summary(self, values: Mapping[str, float], text: str, step: int) -> None:
        self._called("summary")
        assert "| task |" in text
        self.final = dict(values)

    def close(self, ok: bool) -> None:
        self._called("close")
        self.closed.append(ok)


@pytest.fixture
def notes(monkeypatch: pytest.MonkeyPatch) -> Notes:
    """Stands in for tensorboard; numbers are logged whenever an episode has ended."""
    notes = Notes()
    monkeypatch.setattr(trackers, "make_tracker", lambda name: notes)
    monkeypatch.setattr(trackers, "INTERVAL_S", 0.0)
    return notes


def settings(**values: Any) -> EvalConfig:
    return EvalConfig(**{"suite": SUITE, "policy": "zero", "tasks": "0-1", "track": "tensorboard", **values})


def evaluate(folder: Path, world: FakeWorld | None = None, **values: Any) -> Any:
    config, world = settings(**values), world or FakeWorld()
    return Evaluation(config, world.simulator).run(begin(config, folder))


def test_a_run_is_told_settings_numbers_and_the_summary(notes: Notes, tmp_path: Path) -> None:
    result = evaluate(tmp_path / "run", num_envs=2)
    (run,) = notes.runs
    assert (run.name, run.group, run.folder) == ("run", "", tmp_path / "run")
    assert run.config["tasks"] == "0-1"
    assert run.config["conditions"] == json.loads((tmp_path / "run" / "config.json").read_text())["conditions"]
    step, last = notes.logged[-1]
    assert step == 10
    assert (last["episodes"], last["successes"], last["success_rate"]) == (10, 5, 0.5)
    assert (last["task/0/success_rate"], last["task/1/success_rate"]) == (1.0, 0.0)
    assert last[f"suite/{SUITE}/success_rate"] == 0.5
    assert last["episodes_per_s"] > 0
    assert last["time/policy_s"] == pytest.approx(sum(r.policy_s for r in result.records) / 10)
    assert [step for step, _ in notes.logged] == sorted({step for step, _ in notes.logged})
    assert (notes.final["final/rate"], notes.final["final/missing"]) == (0.5, 0)
    assert notes.closed == [True]


def test_numbers_come_at_a_bounded_rate_and_at_the_end(
    notes: Notes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(trackers, "INTERVAL_S", 1e6)
    evaluate(tmp_path / "run", num_envs=2)
    assert [step for step, _ in notes.logged] == [1, 10]


def test_a_resumed_run_has_the_same_id_and_counts_what_was_there(notes: Notes, tmp_path: Path) -> None:
    world = FakeWorld(raise_in={1: KeyboardInterrupt()})
    assert evaluate(tmp_path / "run", world, num_envs=5).interrupted
    assert notes.closed == [False]
    config, store = resume(tmp_path / "run")
    assert Evaluation(config, FakeWorld().simulator).run(store).ok
    first, second = notes.runs
    assert first.id == second.id
    assert len(first.id) == 32
    assert notes.logged[-1][1]["success_rate"] == 0.5


def test_runs_of_a_campaign_are_a_group(notes: Notes, tmp_path: Path) -> None:
    config = settings(seeds="0,1")
    Campaign(config, tmp_path / "both", FakeWorld().simulator).run()
    assert [(run.group, run.name) for run in notes.runs] == [("both", f"both/seed-{seed}/{SUITE}") for seed in (0, 1)]
    assert len({run.id for run in notes.runs}) == 2


def test_videos_of_failures_are_handed_on_up_to_a_limit(
    notes: Notes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(trackers, "MOST_VIDEOS", 3)
    tell = Tracking.progress

    def with_files(self: Tracking, now: Any) -> None:
        for record in now.ended:
            video_path(tmp_path / "run", record.key).parent.mkdir(exist_ok=True)
            video_path(tmp_path / "run", record.key).touch()
        tell(self, now)

    monkeypatch.setattr(Tracking, "progress", with_files)
    evaluate(tmp_path / "run")
    assert [name for name, _ in notes.videos] == ["failure/1/0", "failure/1/1", "failure/1/2"]
    assert all(path.exists() for _, path in notes.videos)


@pytest.mark.parametrize("broken", ["start", "log", "summary", "close"])
def test_a_tracker_that_fails_costs_a_warning_and_no_episode(
    notes: Notes, broken: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    notes.broken = broken
    with caplog.at_level(logging.WARNING):
        result = evaluate(tmp_path / "run")
    assert result.ok
    assert len(result.records) == 10
    assert not any(record.error for record in result.records)
    (said,) = caplog.messages
    assert said == (
        f"tracking with tensorboard has stopped, the evaluation goes on: ConnectionError: no network in {broken}"
    )
    assert notes.closed == []


def test_a_tracker_that_cannot_be_imported_costs_a_warning(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(name: str) -> None:
        raise ImportError(f"{name} is of another version")

    monkeypatch.setattr(trackers, "make_tracker", broken)
    with caplog.at_level(logging.WARNING):
        assert evaluate(tmp_path / "run").ok
    assert "tensorboard is of another version" in caplog.text


def test_an_evaluation_that_is_refused_leaves_no_run_behind(notes: Notes, tmp_path: Path) -> None:
    world = FakeWorld()
    world.refuse = ValueError("no such backend")
    with pytest.raises(ConfigError):
        evaluate(tmp_path / "run", world)
    assert notes.runs == []
    assert not (tmp_path / "run").exists()


def test_trackers_are_a_list_with_commas() -> None:
    assert settings(track="wandb, trackio,wandb").trackers == ("wandb", "trackio")
    assert settings(track="none").trackers == EvalConfig(suite=SUITE, policy="zero").trackers == ()
    with pytest.raises(ConfigError, match="unknown tracker 'wandbb': did you mean wandb"):
        settings(track="wandbb")


@pytest.mark.parametrize("name", TRACKERS)
def test_a_package_that_is_missing_is_named_before_anything_runs(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(runner, "vecenv_simulator", lambda: FakeWorld().simulator)
    monkeypatch.setattr(trackers, "is_installed", lambda module: False)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(build_app(), ["eval", "--suite", SUITE, "--policy", "zero", "--track", name])
    assert done.exit_code == 2
    assert done.stderr.startswith(f"error: --track {name}: ")
    assert done.stderr.endswith(f" is not installed: pip install 'vecenv[{name}]'\n")
    assert list(tmp_path.iterdir()) == []


def test_every_tracker_has_an_extra(repository: Path) -> None:
    import tomllib

    optional = tomllib.loads((repository / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(extras.EXTRAS.values()) <= set(optional)
    for name in TRACKERS:
        assert any(requirement.startswith(trackers._KINDS[name][1]) for requirement in optional[name])


def test_tensorboard_reads_back_what_was_logged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    pytest.importorskip("tensorboardX")
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    monkeypatch.setattr(trackers, "INTERVAL_S", 0.0)
    world = FakeWorld(raise_in={1: KeyboardInterrupt()})
    assert evaluate(tmp_path / "run", world, num_envs=5).interrupted
    config, store = resume(tmp_path / "run")
    assert Evaluation(config, FakeWorld().simulator).run(store).ok
    events = accumulator.EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    events.Reload()
    rates = [(event.step, event.value) for event in events.Scalars("success_rate")]
    assert rates[-1] == (10, 0.5)
    assert {"task/0/success_rate", "task/1/success_rate", "episodes_per_s", "final/rate"} <= set(
        events.Tags()["scalars"]
    )
    texts = {tag: events.Tensors(tag)[-1].tensor_proto.string_val[0].decode() for tag in events.Tags()["tensors"]}
    assert '"policy": "zero"' in texts["config/text_summary"]
    assert "| task |" in texts["report/text_summary"]


def in_a_process(code: str, *arguments: str, **environment: str) -> dict[str, Any]:
    """The JSON that code prints last, in a process whose trackers find their files by environment variables."""
    path = os.pathsep.join(filter(None, sys.path))
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        env={**os.environ, **environment, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


RUN = """
import json, sys
from pathlib import Path
from support.fakes import SUITE, FakeWorld
from vecenv_eval import trackers
from vecenv_eval.config import EvalConfig
from vecenv_eval.results import begin, resume
from vecenv_eval.runner import Evaluation
trackers.INTERVAL_S = 0.0
folder, name = Path(sys.argv[1]), sys.argv[2]
config = EvalConfig(suite=SUITE, policy="zero", tasks="0-1", track=name, num_envs=5)
assert Evaluation(config, FakeWorld(raise_in={1: KeyboardInterrupt()}).simulator).run(begin(config, folder)).interrupted
config, store = resume(folder)
assert Evaluation(config, FakeWorld().simulator).run(store).ok
"""


def test_trackio_reads_back_what_was_logged(tmp_path: Path) -> None:
    pytest.importorskip("trackio")
    code = RUN + (
        "import trackio\n"
        "from trackio.sqlite_storage import SQLiteStorage\n"
        "(run,) = trackio.Api().runs('vecenv')\n"
        "rows = SQLiteStorage.get_logs('vecenv', run.name)\n"
        "print(json.dumps({'name': run.name, 'config': run.config, 'rows': rows}))"
    )
    found = in_a_process(code, str(tmp_path / "run"), "trackio", TRACKIO_DIR=str(tmp_path / "trackio"))
    assert found["name"].startswith("run-")
    assert found["config"]["policy"] == "zero"
    rates = [row["success_rate"] for row in found["rows"] if "success_rate" in row]
    assert rates[-1] == 0.5
    assert found["rows"][-1]["final/rate"] == 0.5


def test_wandb_works_offline(tmp_path: Path) -> None:
    pytest.importorskip("wandb")
    code = RUN + "print(json.dumps(store.config()))"
    config = in_a_process(code, str(tmp_path / "run"), "wandb", WANDB_MODE="offline")
    runs = list((tmp_path / "run" / "wandb").glob("offline-run-*"))
    assert len(runs) >= 1
    assert all(run.name.endswith(config["tracking_id"]) for run in runs)
    assert all(list(run.glob("*.wandb")) for run in runs)
