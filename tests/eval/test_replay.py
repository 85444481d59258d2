"""Replay: recorded actions, executed again, come to the verdicts and states on record."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace as changed
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from support import demo_files, upstream
from support.demo_files import Rollout
from support.fakes import SUITE, FakeEnv, FakeWorld
from typer.testing import CliRunner, Result
from vecenv_eval.config import EvalConfig
from vecenv_eval.demos.files import find_files, read_files
from vecenv_eval.demos.mjcf import fixture_poses
from vecenv_eval.demos.outcomes import ReplayReport, closing_line
from vecenv_eval.demos.record import DemoRecorder, RecordError
from vecenv_eval.demos.replay import NO_FIXTURES, ReplayConfig, replay
from vecenv_eval.demos.schema import Recording
from vecenv_eval.demos.write import write_demos
from vecenv_eval.episodes import Episode
from vecenv_eval.results import EvalResult, begin, resume
from vecenv_eval.runner import evaluate
from vecenv_eval.store import Record
from vecenv_eval.watch import watching

from vecenv.cli import build_app
from vecenv.contract import BatchEnv, Control, ResetInfo, State
from vecenv.libero.tasks.suites import TaskSpec
from vecenv.libero.tasks.suites import task as task_spec

STOVE, BURNER = task_spec("libero_goal", 7), task_spec("libero_goal", 1)
TICKS = 25


def run(paths: list[Path], **options: Any) -> ReplayReport:
    demos, problems = read_files(find_files(paths))
    return changed(replay(demos, ReplayConfig(**options)), problems=tuple(problems))


def invoke(*arguments: object) -> Result:
    return CliRunner(env={"COLUMNS": "200"}).invoke(build_app(), ["replay", *map(str, arguments)])


# -- upstream's rollouts -----------------------------------------------------------------------------------------------


def solved_start(peer: Any, spec: TaskSpec, state: np.ndarray) -> np.ndarray:
    """A start that is solved within a tick or a few: the stove is on, or the bowl just above its burner."""
    model, state = upstream.model_of(peer), state.copy()
    qpos = state[1 : 1 + model.nq]
    if spec is STOVE:
        qpos[model.joint("flat_stove_1_button").qposadr[0]] = 1.0
    else:
        bowl = model.joint("akita_black_bowl_1_joint0").qposadr[0]
        qpos[bowl : bowl + 3] = upstream.data_of(peer).site("flat_stove_1_cook_region").xpos + [0.0, 0.0, 0.04]
    return state


def stand_as_saved(peer: Any, spec: TaskSpec, text: str) -> None:
    """Move upstream's fixtures to where its own MJCF has them: saved with six digits, which is what demos replay in."""
    poses = fixture_poses(text, spec)
    bodies = [upstream.model_of(peer).body(f"{name}_main").id for name in poses]
    upstream.set_fixtures(peer, bodies, *(np.array([pose[part] for pose in poses.values()]) for part in (0, 1)))


def random_actions(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    actions = np.repeat(rng.uniform(-1, 1, (5, 7)), 5, axis=0)
    actions[:, 6] = np.sign(actions[:, 6])
    return actions


def upstream_rollout(spec: TaskSpec, seed: int, solved: bool) -> Rollout:
    """What LIBERO does with random actions until the task is solved, or for all of them."""
    peer = upstream.peer_of(spec.bddl_path)
    peer.seed(seed)
    with upstream.silence():
        peer.reset()
    text = peer.sim.model.get_xml()
    stand_as_saved(peer, spec, text)
    start = spec.init_states()[seed]
    peer.set_init_state(start)
    if solved:
        peer.set_init_state(solved_start(peer, spec, start))
    states, done, actions = [], False, random_actions(seed)
    while not done and len(states) < TICKS:
        states.append(peer.get_sim_state())
        _, _, done, _ = peer.step(actions[len(states) - 1])
    return Rollout(
        actions=actions[: len(states)],
        states=np.array(states),
        success=bool(done),
        model_file=text,
        final_state=peer.get_sim_state(),
    )


@pytest.fixture(scope="module")
def rollouts() -> dict[TaskSpec, list[Rollout]]:
    """Three rollouts of two tasks each, the last of each solved."""
    return {spec: [upstream_rollout(spec, seed, solved=seed == 2) for seed in range(3)] for spec in (STOVE, BURNER)}


@pytest.fixture
def folder(tmp_path: Path, rollouts: dict[TaskSpec, list[Rollout]]) -> Path:
    """The rollouts as LIBERO publishes them: a file a task, nothing about the state after the last action."""
    folder = tmp_path / "published"
    folder.mkdir()
    for spec, some in rollouts.items():
        published = [changed(rollout, final_state=None) for rollout in some]
        demo_files.write(folder / f"{spec.name}_demo.hdf5", spec, published)
    return folder


def test_upstreams_rollouts_end_here_as_they_did_there(tmp_path: Path, rollouts: dict[TaskSpec, list[Rollout]]) -> None:
    for spec, some in rollouts.items():
        demo_files.write(tmp_path / f"{spec.name}.hdf5", spec, some)
    report = run([tmp_path], contacts="current")
    assert report.ok
    assert sorted((o.task, o.name, o.recorded) for o in report.outcomes) == [
        (task, f"demo_{i}", i == 2) for task in (1, 7) for i in range(3)
    ]
    for outcome in report.outcomes:
        assert outcome.ticks == outcome.length
        assert (outcome.ticks == TICKS) == (not outcome.replayed)
        assert outcome.qpos_error is not None
        assert outcome.qpos_error <= 1e-6, outcome
        assert outcome.note == outcome.fault == ""


def test_fixtures_stand_where_the_file_has_them(folder: Path) -> None:
    """With the stove half a metre aside, the bowl that fell onto its burner falls onto the table."""
    path = folder / f"{BURNER.name}_demo.hdf5"
    with h5py.File(path, "r+") as file:
        demo: Any = file["data/demo_2"]
        text = demo.attrs["model_file"]
        x, y, z = re.search(r'name="flat_stove_1_main" pos="(\S+) (\S+) (\S+)"', text).groups()  # pyright: ignore
        demo.attrs["model_file"] = text.replace(f'"{x} {y} {z}"', f'"{x} {float(y) - 0.5} {z}"')
    moved = next(o for o in run([folder]).outcomes if (o.task, o.name) == (1, "demo_2"))
    assert (moved.recorded, moved.replayed) == (True, False)


def test_without_an_mjcf_fixtures_are_at_their_centres_and_that_is_said(folder: Path) -> None:
    for path in folder.iterdir():
        with h5py.File(path, "r+") as file:
            data: Any = file["data"]
            for demo in data.values():
                del demo.attrs["model_file"]
    report = run([folder])
    assert len(report.outcomes) == 6
    assert {outcome.note for outcome in report.outcomes} == {NO_FIXTURES}


def test_the_command_prints_both_verdicts_and_exits_0_when_they_agree(folder: Path, tmp_path: Path) -> None:
    result = invoke(folder, "--contacts", "current", "--out", tmp_path / "out.json")
    assert result.exit_code == 0, result.output
    assert "batch 1/1: 6 demonstrations of up to 25 ticks" in result.stdout
    assert "verdicts agree: 6/6 (95 % interval 61.0%-100.0%)" in result.stdout
    assert result.stdout.count("solved") == 4
    content = json.loads((tmp_path / "out.json").read_text())
    assert (content["agreeing"], content["compared"], content["ok"], content["problems"]) == (6, 6, True, [])
    assert len(content["demos"]) == 6
    # The last state on record is the one before the last action.
    assert all(demo["qpos_error"] <= 1e-6 for demo in content["demos"])


def test_a_verdict_that_differs_and_a_demonstration_that_is_broken_exit_1_and_the_others_run(folder: Path) -> None:
    with h5py.File(folder / f"{STOVE.name}_demo.hdf5", "r+") as file:
        data: Any = file["data"]
        data["demo_0/rewards"][-1] = 1
        data.copy("demo_1", "demo_3")
        demo_files.replace(data["demo_3"], "actions", np.zeros((2, 2)))
    result = invoke(folder)
    assert result.exit_code == 1
    assert "verdicts agree: 5/6 (95 % interval 43.6%-97.0%), 1 not replayed" in result.stdout
    assert f"{STOVE.name}_demo.hdf5: demo_3: actions: expected [T, 7]" in result.stdout


def test_a_demonstration_goes_on_while_a_shorter_one_is_through_and_is_judged_by_its_own_actions(
    folder: Path, rollouts: dict[TaskSpec, list[Rollout]]
) -> None:
    """Cut before the bowl has come down, the burner's demonstration fails, though its slot would solve it by idling."""
    path = folder / f"{BURNER.name}_demo.hdf5"
    length = len(rollouts[BURNER][2].actions)
    assert length > 1
    with h5py.File(path, "r+") as file:
        demo: Any = file["data/demo_2"]
        for name in ("actions", "states", "dones", "rewards"):
            demo_files.replace(demo, name, demo[name][: length - 1])
        demo["rewards"][-1] = 0
    report = run([folder])
    assert report.ok
    (cut,) = (o for o in report.outcomes if (o.task, o.name) == (1, "demo_2"))
    assert (cut.recorded, cut.replayed, cut.ticks) == (False, False, length - 1)


def test_a_demonstration_that_goes_on_after_it_is_solved_counts_as_solved(folder: Path) -> None:
    """As people recorded them: ten more ticks after the goal first held."""
    with h5py.File(folder / f"{STOVE.name}_demo.hdf5", "r+") as file:
        demo: Any = file["data/demo_2"]
        for name in ("actions", "states"):
            demo_files.replace(demo, name, np.concatenate([demo[name][()], np.repeat(demo[name][-1:], 10, axis=0)]))
        demo_files.replace(demo, "rewards", np.eye(len(demo["actions"]))[-1])
        demo_files.replace(demo, "dones", np.eye(len(demo["actions"]))[-1])
    report = run([folder])
    assert report.ok
    (longer,) = (o for o in report.outcomes if (o.task, o.name) == (7, "demo_2"))
    assert longer.ticks < longer.length


def test_without_verdicts_on_record_nothing_agrees(folder: Path) -> None:
    for path in folder.iterdir():
        with h5py.File(path, "r+") as file:
            data: Any = file["data"]
            for demo in data.values():
                del demo["rewards"], demo["dones"]
    result = invoke(folder)
    assert result.exit_code == 1
    assert "no verdicts to compare, 6 without a verdict on record" in result.stdout


def test_what_the_environment_refuses_is_a_problem_of_that_batch(folder: Path) -> None:
    with h5py.File(folder / f"{STOVE.name}_demo.hdf5", "r+") as file:
        demo: Any = file["data/demo_0"]
        demo.attrs.update(episode=0, make=json.dumps({"start": "nowhere"}))
    demos, problems = read_files([folder / f"{STOVE.name}_demo.hdf5"])
    assert not problems
    report = replay(demos[:1])
    assert not report.outcomes
    assert "demo_0: cannot be replayed: LiberoError: start='nowhere' is not available" in str(report.problems[0])
    assert closing_line(report) == "no verdicts to compare, 1 not replayed"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere.hdf5"], "nowhere.hdf5: no such file"),
        (["."], ".: no HDF5 file in this folder"),
        (["x.hdf5", "--task", "3"], "--task needs --suite"),
        (["x.hdf5", "--suite", "libero_gaol"], "unknown suite 'libero_gaol': did you mean libero_goal"),
        (["x.hdf5", "--suite", "libero_goal", "--task", "10"], "--task 10: libero_goal has tasks 0 to 9"),
        (["x.hdf5", "--out", "no/where.json"], "--out no/where.json: there is no folder"),
    ],
)
def test_arguments_that_make_no_sense_get_one_line_and_status_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {says}")
    assert len(result.stderr.splitlines()) == 1


def test_a_file_that_is_no_demonstration_file_exits_1(tmp_path: Path) -> None:
    (tmp_path / "x.hdf5").write_text("hello")
    result = invoke(tmp_path)
    assert result.exit_code == 1
    assert "x.hdf5: not a readable HDF5 file" in result.stdout


# -- our own recordings ------------------------------------------------------------------------------------------------


class Roaming:
    """Random poses and random actions in turn, so that both verbs are recorded."""

    name = "roaming"

    def reset(self, env: BatchEnv, info: ResetInfo) -> None:
        self._rng, self._calls = np.random.default_rng(0), 0

    def act(self, env: BatchEnv) -> np.ndarray | Control:
        self._calls += 1
        if self._calls % 2:
            return self._rng.uniform(-1.2, 1.2, (env.num_envs, 3, 7))  # some are clipped
        poses = np.tile([-0.1, 0.0, 1.1, 0.0, 1.0, 0.0, 0.0, 0.0], (env.num_envs, 1))
        poses[:, :3] += self._rng.uniform(-0.05, 0.05, (env.num_envs, 3))
        return env.step_ee_pose(poses)


@pytest.mark.parametrize(
    "env_args",
    [
        {"start": "settled"},
        {"start": "raw", "settle_steps": 2, "fixtures": "sampled"},
        {"start": "raw", "settle_steps": 2, "fixtures": {"flat_stove_1": [[-0.42, 0.22, 0.905], [1.0, 0.0, 0.0, 0.0]]}},
    ],
    ids=["settled", "sampled", "given"],
)
def test_our_own_recordings_replay_bit_for_bit(tmp_path: Path, env_args: dict[str, Any]) -> None:
    config = EvalConfig(
        suite="libero_goal",
        policy=f"{__name__}:Roaming",
        tasks="7-8",
        episodes="1,3-4",
        max_steps=20,
        seed=5,
        env_args=env_args,
        record_states=True,
    )
    result = evaluate(config, begin(config, tmp_path / "results"))
    assert result.ok, result.causes
    assert sorted(p.name for p in (tmp_path / "results" / "demos").iterdir()) == [
        "libero_goal_7.hdf5",
        "libero_goal_8.hdf5",
    ]
    report = run([tmp_path / "results"])
    assert report.ok
    verdicts = {(o.task, o.name): (o.replayed, o.ticks) for o in report.outcomes}
    assert verdicts == {(r.task, f"demo_{r.episode}"): (r.success, r.num_steps) for r in result.records}
    assert [(o.qpos_error, o.qvel_error) for o in report.outcomes] == [(0.0, 0.0)] * 6


class Visible(FakeEnv):
    """A fake whose executed actions can be seen; its state is how many ticks it has run."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.watchers: list[Callable[[np.ndarray, np.ndarray], None]] = []
        super().__init__(*args, **options)

    @contextmanager
    def watched(self, watcher: Callable[[np.ndarray, np.ndarray], None]) -> Iterator[None]:
        self.watchers.append(watcher)
        yield
        self.watchers.remove(watcher)

    def _tick(self) -> None:
        for watcher in self.watchers:
            watcher(self.actions[-1], ~(self.terminated | self.truncated))
        super()._tick()

    def state(self) -> State:
        ticks, one = self.ticks[:, None].astype(float), np.ones(self.num_envs, int)
        return State(qpos=ticks, qvel=-ticks, time=ticks[:, 0] / 20, nq=one, nv=one)


class VisibleWorld(FakeWorld):
    """The fake suite, recordable."""

    def make(self, suite: str, *, tasks: Any, episodes: Any, max_steps: int = 10, seed: int = 0, **_: Any) -> FakeEnv:
        self.envs.append(Visible(tasks, episodes, max_steps=max_steps, faults=self.faults, raise_in=self.raise_in))
        return self.envs[-1]


def record(folder: Path, world: FakeWorld, **settings: Any) -> EvalResult:
    config = EvalConfig(**{"suite": SUITE, "policy": "random", "record": True, **settings})
    return evaluate(config, begin(config, folder), simulator=world.simulator)


def recorded(folder: Path) -> dict[str, Any]:
    """Actions, states and attributes of every recording in a results folder, by ``task/demo``."""
    found: dict[str, Any] = {}
    for path in sorted((folder / "demos").glob("*.hdf5")):
        with h5py.File(path) as file:
            data: Any = file["data"]
            for name, demo in data.items():
                arrays = {key: value[()] for key, value in demo.items()}
                found[f"{data.attrs['task']}/{name}"] = {**arrays, **demo.attrs}
    return found


def test_a_recording_holds_the_executed_ticks_of_its_own_slot(tmp_path: Path) -> None:
    world = VisibleWorld()
    result = record(tmp_path / "r", world, tasks="0-1", record_states=True, max_steps=6)
    found = recorded(tmp_path / "r")
    assert len(found) == len(result.records) == 10
    actions = {(t, e): env.actions for env in world.envs for t in env.tasks for e in env.episodes}
    for r in result.records:
        demo = found[f"{r.task}/demo_{r.episode}"]
        assert len(demo["actions"]) == demo["num_samples"] == r.num_steps
        env = next(env for env in world.envs if r.task in env.tasks)
        slot = next(i for i in range(env.num_envs) if (env.tasks[i], env.episodes[i]) == (r.task, r.episode))
        executed = [tick[slot] for tick in actions[r.task, r.episode][: r.num_steps]]
        np.testing.assert_array_equal(demo["actions"], executed)
        np.testing.assert_array_equal(demo["states"][:, 1], np.arange(r.num_steps))
        np.testing.assert_array_equal(demo["final_state"], [r.num_steps / 20, r.num_steps, -r.num_steps])
        assert (demo["success"], demo["episode"]) == (r.success, r.episode)
        assert json.loads(demo["make"]) == {"max_steps": 6, "seed": 0}


def test_states_are_kept_only_when_asked_for(tmp_path: Path) -> None:
    record(tmp_path / "r", VisibleWorld(), tasks="0")
    assert all("states" not in demo for demo in recorded(tmp_path / "r").values())
    record(tmp_path / "none", VisibleWorld(), tasks="0", record=False)
    assert not (tmp_path / "none" / "demos").exists()


def test_a_batch_that_raises_leaves_the_recordings_of_what_has_a_verdict(tmp_path: Path) -> None:
    world = VisibleWorld(raise_in={0: ValueError("boom")})
    result = record(tmp_path / "r", world, tasks="0")
    kept = {f"{r.task}/demo_{r.episode}" for r in result.records if not r.error}
    assert recorded(tmp_path / "r").keys() == kept == {"0/demo_0"}
    config, store = resume(tmp_path / "r")
    assert config.record
    evaluate(config, store, simulator=VisibleWorld().simulator)
    assert len(recorded(tmp_path / "r")) == 5


def test_a_fault_is_on_record(tmp_path: Path) -> None:
    record(tmp_path / "r", VisibleWorld(faults={(0, 3): "it flew away"}), tasks="0")
    demo = recorded(tmp_path / "r")["0/demo_3"]
    assert (demo["success"], demo["fault"], len(demo["actions"])) == (False, "it flew away", 1)


def test_fixture_poses_that_differ_between_slots_are_each_slots_own(tmp_path: Path) -> None:
    env = Visible([0], [0, 1])
    poses = {"shelf": (np.array([[1.0, 2, 3], [4, 5, 6]]), np.array([1.0, 0, 0, 0]))}
    recorder = DemoRecorder(keep_in(tmp_path), ["do it"], {"fixtures": poses})
    recorder.begin(env, {0: Episode(SUITE, 0, 0), 1: Episode(SUITE, 0, 1)})
    with watching(env, [recorder]):
        env.step_continuous(np.zeros((2, 7)))
    recorder.finish(env, {0: ended(0), 1: ended(1, success=False)})
    fixtures = [json.loads(demo["make"])["fixtures"] for demo in recorded(tmp_path).values()]
    assert fixtures == [{"shelf": [[1, 2, 3], [1, 0, 0, 0]]}, {"shelf": [[4, 5, 6], [1, 0, 0, 0]]}]


def test_an_environment_that_hides_its_actions_is_not_recorded(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="FakeEnv does not show the actions it executes"):
        DemoRecorder(keep_in(tmp_path), [], {}).begin(FakeEnv([0], [0]), {0: Episode(SUITE, 0, 0)})
    result = record(tmp_path / "r", FakeWorld(), tasks="0")
    assert result.causes == ("RecordError: FakeEnv does not show the actions it executes, so it cannot be recorded",)


def test_only_what_happens_while_it_watches_is_recorded(tmp_path: Path) -> None:
    env = Visible([0], [3])
    recorder = DemoRecorder(keep_in(tmp_path), ["do it"], {})
    recorder.begin(env, {0: Episode(SUITE, 0, 3)})
    with watching(env, [recorder]):
        env.step_continuous(np.zeros((1, 2, 7)))
    env.step_continuous(np.ones((1, 7)))
    recorder.finish(env, {0: ended(3)})
    np.testing.assert_array_equal(recorded(tmp_path)["0/demo_3"]["actions"], np.zeros((2, 7)))


def test_what_a_slot_did_in_an_episode_that_never_finished_is_dropped(tmp_path: Path) -> None:
    env = Visible([0], [3])
    recorder = DemoRecorder(keep_in(tmp_path), ["do it"], {})
    for value in (1.0, 2.0):  # the first is broken off
        recorder.begin(env, {0: Episode(SUITE, 0, 3)})
        with watching(env, [recorder]):
            env.step_continuous(np.full((1, 7), value))
    recorder.finish(env, {0: ended(3)})
    recorder.finish(env, {0: ended(3)})  # the slot has not begun again: nothing to write
    np.testing.assert_array_equal(recorded(tmp_path)["0/demo_3"]["actions"], np.full((1, 7), 2.0))


def keep_in(folder: Path) -> Callable[[str, int, str, Sequence[Recording]], None]:
    """Writes recordings into one file of a folder."""
    return partial(write_demos, folder / "demos" / "x.hdf5")


def ended(episode: int, success: bool = True) -> Record:
    """How an episode of the fake suite went."""
    how = {"instruction": "do it", "success": success, "num_steps": 1, "reward": float(success)}
    return Record(suite=SUITE, task=0, episode=episode, **how)
