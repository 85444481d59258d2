"""Recordings of SIMPLER's episodes: what is in them, and that they replay to the same verdicts and states."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner, Result
from vecenv_eval.config import EvalConfig
from vecenv_eval.demos.files import find_files, read_files
from vecenv_eval.demos.outcomes import ReplayReport
from vecenv_eval.demos.replay import OTHER_FILES, ReplayConfig, replay
from vecenv_eval.report.html import page
from vecenv_eval.report.run import read_run
from vecenv_eval.results import EvalResult, begin, resume
from vecenv_eval.runner import evaluate
from vecenv_eval.store import StoreError

from vecenv.cli import build_app
from vecenv.contract import BatchEnv, ResetInfo

pytest.importorskip("sapien")
pytest.importorskip("ruckig")
CARROT, PLACE = "widowx_carrot_on_plate", "google_robot_place_apple_in_closed_top_drawer"
PARTS = ("moved_correct_obj", "moved_wrong_obj", "is_src_obj_grasped", "consecutive_grasp", "src_on_target")


@pytest.fixture(autouse=True)
def assets(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VECENV_SIMPLER_ASSETS", str(small))


def run(folder: Path, **settings: Any) -> EvalResult:
    common = {"suite": "simpler/bridge", "tasks": CARROT, "num_threads": 1, "record": True}
    config = EvalConfig(**{**common, **settings})
    result = evaluate(config, begin(config, folder))
    assert result.ok, result.causes
    return result


def replayed(folder: Path, **options: Any) -> ReplayReport:
    demos, problems = read_files(find_files([folder]))
    assert not problems
    return replay(demos, ReplayConfig(**{"num_threads": 1, **options}))


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory, small: Path) -> Path:
    """Two episodes of one task that the scripted policy solves, recorded with their states."""
    folder = tmp_path_factory.mktemp("recorded") / "r"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VECENV_SIMPLER_ASSETS", str(small))
        run(folder, policy="simpler_scripted", episodes="2", record_states=True)
    return folder


def test_solved_episodes_replay_bit_for_bit_together_and_alone(solved: Path) -> None:
    for together in (2, 1):
        report = replayed(solved, num_envs=together)
        assert report.ok, report.problems
        assert [(o.recorded, o.replayed, o.ticks == o.length) for o in report.outcomes] == [(True, True, True)] * 2
        assert [(o.qpos_error, o.qvel_error) for o in report.outcomes] == [(0.0, 0.0)] * 2


def test_both_robots_replay_under_a_published_protocol_and_a_gripper_convention(tmp_path: Path) -> None:
    shared: dict[str, Any] = {"policy": "random", "max_steps": 4, "env_args": {"gripper": "binary"}}
    run(tmp_path / "a", **shared, episodes="3,20", protocol="visual-matching")
    run(tmp_path / "b", **shared, suite="simpler/google_robot", tasks="google_robot_pick_coke_can", episodes="0,9")
    report = replayed(tmp_path)
    assert report.ok, report.problems
    assert {(o.replayed, o.ticks, o.qpos_error) for o in report.outcomes} == {(False, 4, 0.0)}


def test_a_recording_says_which_episode_it_is_and_holds_every_state(solved: Path) -> None:
    with h5py.File(solved / "demos" / "simpler-bridge_1.hdf5") as file:
        data: Any = file["data"]
        attributes = {name: data.attrs[name] for name in ("suite", "task", "task_name", "num_demos")}
        assert attributes == {"suite": "simpler/bridge", "task": 1, "task_name": CARROT, "num_demos": 2}
        demo = data["demo_1"]
        names = ("episode", "protocol", "seed", "setting", "instruction", "success")
        found = tuple(demo.attrs[name] for name in names)
        assert found == (1, "seed", 2023, "base", "put carrot on plate", True)
        assert json.loads(demo.attrs["make"])["gripper"] == "native"
        assert len(demo["states"]) == len(demo["actions"]) == demo.attrs["num_samples"]
        np.testing.assert_array_equal(demo["states"][0], demo.attrs["init_state"])
        assert demo.attrs["final_state"].shape == demo.attrs["init_state"].shape


def test_it_is_said_when_other_files_are_missing_than_on_record(solved: Path, tmp_path: Path) -> None:
    path = tmp_path / "copy.hdf5"
    path.write_bytes((solved / "demos" / "simpler-bridge_1.hdf5").read_bytes())
    with h5py.File(path, "r+") as file:
        data: Any = file["data"]
        assert "bridge_table_1_v1.glb is missing" in data["demo_0"].attrs["stand_ins"]
        data["demo_0"].attrs["stand_ins"] = "[]"
    assert [outcome.note for outcome in replayed(tmp_path).outcomes] == [OTHER_FILES, ""]


class Advancing:
    """Says after two ticks that the first half of the task is done, in every second slot."""

    name = "advancing"

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self.ticks = 0

    def act(self, env: Any) -> np.ndarray:
        if self.ticks == 2:
            env.advance_subtask(np.arange(env.num_envs) % 2 == 1)
        self.ticks += 1
        return np.zeros((env.num_envs, 7))


class Halves:
    """A recorder that notes which half each tick of each episode belongs to."""

    def __init__(self) -> None:
        self.seen: dict[int, list[bool]] = {}

    def begin(self, env: Any, episodes: Mapping[int, Any]) -> None:
        self.env, self.episodes = env, dict(episodes)

    def observe(self, env: Any, slots: Sequence[int], actions: np.ndarray) -> None:
        for slot in slots:
            self.seen.setdefault(self.episodes[slot].episode, []).append(bool(self.env.second_half[slot]))

    def finish(self, env: Any, records: Mapping[int, Any]) -> None: ...

    def close(self) -> None: ...


def test_the_second_half_of_a_task_begins_at_the_tick_on_record(tmp_path: Path) -> None:
    settings = {"suite": "simpler/google_robot", "tasks": PLACE, "episodes": "2", "max_steps": 5}
    run(tmp_path, **settings, policy=f"{__name__}:Advancing")
    demos, _ = read_files(find_files([tmp_path]))
    assert demos[0].second_half is None
    assert demos[1].second_half is not None
    assert demos[1].second_half.tolist() == [False, False, True, True, True]
    halves = Halves()
    assert replay(demos, ReplayConfig(num_threads=1), recorders=[halves]).ok
    assert halves.seen == {0: [False] * 5, 1: [False, False, True, True, True]}


# -- the files are not trusted -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda demo: demo.attrs.pop("make"),
            "it has no attribute make, which says where an episode",
        ),
        (lambda demo: demo.attrs.create("make", '{"assets": "/"}'), "'assets' is none of backend, gripper, max_steps"),
        (lambda demo: demo.attrs.create("make", '{"protocol": 3}'), "protocol=3: expected str"),
        (lambda demo: demo.attrs.create("make", '{"protocol": "x"}'), "protocol='x' is not available"),
        (lambda demo: demo.attrs.create("make", '{"protocol": "variant-aggregation"}'), f"has no episodes of {CARROT}"),
        (lambda demo: demo.attrs.create("episode", 50), "attribute episode: expected 0 to 49, got"),
        (lambda demo: demo.attrs.create("stand_ins", "{"), "attribute stand_ins: not JSON"),
        (lambda demo: demo.attrs.create("stand_ins", "[1]"), "attribute stand_ins: expected a JSON list of texts"),
        (lambda demo: demo.create_dataset("second_half", data=[1, 0]), "second_half: expected one number an action"),
    ],
)
def test_a_broken_recording_is_named_and_the_others_are_read(
    solved: Path, tmp_path: Path, change: Callable[[Any], object], says: str
) -> None:
    path = tmp_path / "copy.hdf5"
    path.write_bytes((solved / "demos" / "simpler-bridge_1.hdf5").read_bytes())
    with h5py.File(path, "r+") as file:
        change(file["data/demo_0"])
    demos, (bad,) = read_files([path])
    assert [demo.name for demo in demos] == ["demo_1"]
    assert bad.name == "demo_0"
    assert says in bad.reason


# -- parts -------------------------------------------------------------------------------------------------------------


def test_parts_of_success_are_in_records_summary_and_report(solved: Path) -> None:
    config, store = resume(solved)
    result = evaluate(config, store)
    assert [tuple(record.parts) for record in result.records] == [PARTS] * 2
    assert all(isinstance(value, bool) for record in result.records for value in record.parts.values())
    by_name = {part.name: part for part in result.summary.parts}
    assert tuple(by_name) == PARTS
    assert (by_name["src_on_target"].held, by_name["src_on_target"].share) == (2, 1.0)
    assert (by_name["moved_wrong_obj"].held, by_name["moved_wrong_obj"].share) == (0, 0.0)
    assert "| 1 | src_on_target | 2/2 | 100.0% |" in (solved / "report.md").read_text()
    first = json.loads((solved / "episodes.jsonl").read_text().splitlines()[0])
    assert first["parts"] == {**dict.fromkeys(PARTS, True), "moved_wrong_obj": False}
    read = read_run(solved)
    assert read.suites[0].summary.parts == result.summary.parts
    shown = page(read, out=solved / "report.html")
    assert '<td>src_on_target</td><td class="n">2/2</td><td class="n">100.0%</td>' in shown


def test_a_part_that_is_a_number_is_averaged(tmp_path: Path) -> None:
    drawer = {"suite": "simpler/google_robot", "tasks": "google_robot_close_top_drawer", "episodes": "2"}
    result = run(tmp_path / "r", **drawer, policy="zero", max_steps=2, record=False)
    (part,) = result.summary.parts
    opened = [record.parts["qpos"] for record in result.records]
    assert (part.name, part.episodes, part.held, part.share) == ("qpos", 2, None, None)
    assert part.mean == pytest.approx(sum(opened) / 2)
    assert part.mean is not None
    assert part.mean > 0.1  # metres: the drawer begins open
    assert f"| qpos | 2 | mean {part.mean:.4g} |" in (tmp_path / "r" / "report.md").read_text()
    shown = page(read_run(tmp_path / "r"), out=tmp_path / "report.html")
    assert all(f"qpos {value}" in shown for value in opened)  # of each episode that failed


def test_parts_that_are_none_are_refused_in_a_report(solved: Path, tmp_path: Path) -> None:
    for name in ("config.json", "episodes.jsonl"):
        text = (solved / name).read_text()
        (tmp_path / name).write_text(text.replace('"parts": {', '"parts": {"is_new": "yes", '))
    with pytest.raises(StoreError, match=r"episodes.jsonl:\d is not an episode: parts is .*, not names and numbers"):
        read_run(tmp_path)


# -- the command -------------------------------------------------------------------------------------------------------


def invoke(*arguments: object) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["replay", *map(str, arguments)])


def test_the_command_replays_them(solved: Path) -> None:
    done = invoke(solved, "--num-threads", "1", "--suite", "simpler/bridge", "--tasks", "*carrot*")
    assert done.exit_code == 0, done.output
    assert "verdicts agree: 2/2" in done.stdout
    assert done.stdout.count("0.0e+00") == 2


@pytest.mark.parametrize(
    ("arguments", "status", "says"),
    [
        (["--contacts", "current"], 2, "simpler/bridge has no option contacts='current'"),
        (["--env-arg", "geometry=lean"], 2, "simpler/bridge has no option geometry='lean'"),
        (["--env-arg", "gripper=binary"], 2, "option gripper='binary': a demonstration decides"),
        (["--backend", "warp"], 2, "backend='warp' is not available; available: physx_cpu"),
        (["--tasks", "widowx_stack_cube"], 2, "none of the 2 demonstrations is one of these"),
        (["--image-size", "64", "--video", "all", "--results", "new"], 2, "does not take --image-size"),
        (["--cameras", "wrist", "--video", "all", "--results", "new"], 2, "there is no camera 'wrist'"),
        (["--suite", "simpler/google_robot"], 1, "it demonstrates simpler/bridge task 1, not simpler/google_robot"),
    ],
)
def test_what_does_not_fit_simplers_recordings_is_refused_by_name(
    solved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], status: int, says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    done = invoke(solved, *arguments)
    assert done.exit_code == status
    assert says in done.output
    assert "Traceback" not in done.output
    assert not list(tmp_path.iterdir())
