"""Upstream's side of a comparison: rollouts of LIBERO under the MuJoCo of another Python environment.

Run as a process by the benchmarks that compare (``trajectories.py``), with the Python of the peer's environment: that
of ``make upstream`` (MuJoCo 3.3.0) or the one that vecenv itself runs in. In: jobs, each a suite, a
task, an episode and by how much to nudge the start or the actions. Out: one ``.npz`` file with the rollout of each job.
It also judges states that are handed to it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import mujoco

ROOT = Path(__file__).resolve().parent.parent
TICKS = 60
SETTLE = 10


@dataclass(frozen=True, kw_only=True)
class Job:
    """One rollout.

    Attributes:
        suite, task, episode: what begins; fixtures stand where upstream's sampler puts them after ``seed(episode)``.
        joint, start_nudge: an arm joint (0 to 6) and by how many radians its start is moved.
        action_nudge: added to every entry of the actions that is not zero.
        actions: ``"random"``, ten idle ticks and fifty random ones; or ``"idle"``.
        ticks: control steps.
    """

    suite: str
    task: int
    episode: int
    joint: int = 0
    start_nudge: float = 0.0
    action_nudge: float = 0.0
    actions: str = "random"
    ticks: int = TICKS


@dataclass(frozen=True, kw_only=True)
class Rollout:
    """What a job gave.

    Attributes:
        fixtures: their names.
        fixture_pos, fixture_quat: their poses, metres [F, 3] and wxyz [F, 4], world frame.
        actions: [T, 7].
        qpos, qvel: after each control step, [T, nq] and [T, nv].
        state: 8-D proprioception as policies get it, [T, 8].
        success: upstream's verdict, bool [T].
        touched: a moving part of the robot touches something else, bool [T].
        mujoco: version.
    """

    fixtures: np.ndarray
    fixture_pos: np.ndarray
    fixture_quat: np.ndarray
    actions: np.ndarray
    qpos: np.ndarray
    qvel: np.ndarray
    state: np.ndarray
    success: np.ndarray
    touched: np.ndarray
    mujoco: np.ndarray


def random_actions(seed: int, ticks: int) -> np.ndarray:
    """Settling ticks, then piecewise constant actions with gripper flips, [ticks, 7]."""
    rng = np.random.default_rng(seed)
    actions = [np.array([0, 0, 0, 0, 0, 0, -1.0])] * SETTLE
    while len(actions) < ticks:
        action = rng.uniform(-1, 1, 7)
        action[2] = rng.uniform(-1, 0.2)  # mostly down, so that the hand meets things
        action[3:6] *= rng.random() < 0.7
        action[6] = rng.choice([-1.0, 1.0])
        actions += [action] * int(rng.integers(1, 8))
    return np.array(actions[:ticks])


def actions_of(job: Job) -> np.ndarray:
    """The actions of a job, [T, 7]."""
    if job.actions == "idle":
        return np.tile([0, 0, 0, 0, 0, 0, -1.0], (job.ticks, 1))
    actions = random_actions(job.episode, job.ticks)
    return np.where(actions != 0, actions + job.action_nudge, actions)


def rollouts(jobs: Sequence[Job], python: str | Path = sys.executable) -> Iterator[Rollout]:
    """The rollouts of these jobs, made by another Python; errors of ``_ask``."""
    asked = {"jobs": np.array(json.dumps([asdict(job) for job in jobs]))}
    made = _ask("rollouts", asked, python)
    for number in range(len(jobs)):
        yield Rollout(**{name: made[f"{number}/{name}"] for name in Rollout.__dataclass_fields__})


def verdicts(
    suite: str,
    task: int,
    states: np.ndarray,
    fixtures: tuple[np.ndarray, np.ndarray, np.ndarray],
    python: str | Path = sys.executable,
) -> np.ndarray:
    """Upstream's verdicts on states [n, nq] of a task, bool [n], by another Python; errors of ``_ask``.

    Args:
        suite, task: the task.
        states: joint positions.
        fixtures: ids of fixtures' bodies [F], positions in metres [F, 3], orientations wxyz [F, 4].
        python: the peer's.
    """
    arrays = dict(zip(("bodies", "pos", "quat"), fixtures, strict=True))
    asked = {"suite": np.array(suite), "task": np.array(task), "states": states, **arrays}
    return _ask("verdicts", asked, python)["verdicts"]


def _ask(question: str, arrays: Mapping[str, np.ndarray], python: str | Path) -> dict[str, np.ndarray]:
    """Let another Python answer.

    Raises:
        RuntimeError: the process failed; the message holds the end of what it printed.
    """
    with tempfile.TemporaryDirectory() as folder:
        asked, made = Path(folder) / "asked.npz", Path(folder) / "made.npz"
        np.savez_compressed(asked, **arrays)  # type: ignore[arg-type]
        command = [str(python), __file__, question, str(asked), str(made)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
        with np.load(made, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """``--contacts`` and ``--peer``, which every comparison with upstream takes."""
    parser.add_argument("--contacts", choices=("published", "current"), default="published", help="ours")
    parser.add_argument(
        "--peer",
        metavar="PYTHON",
        help="upstream's Python; that of `make upstream` (MuJoCo 3.3.0) for published contacts, else this one",
    )


def python_of(options: argparse.Namespace) -> str:
    """The peer's Python as chosen on the command line.

    Raises:
        SystemExit: it is not there; the message has the command that makes it.
    """
    default = ROOT / ".venv-upstream" / "bin" / "python" if options.contacts == "published" else sys.executable
    chosen = Path(options.peer or default)
    if not chosen.is_file():
        raise SystemExit(f"{chosen}: no such file; `make upstream` makes the environment, or name one with --peer")
    return str(chosen)


# ---------------------------------------------------------------------------------------------------------------------
# In the peer's process.


def robot_touches(model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    """Whether a geom of the robot's moving parts touches anything that is not the robot."""
    names = [model.body(model.geom_bodyid[g]).name for g in range(model.ngeom)]
    robot = np.array([name.startswith(("robot0", "gripper0")) for name in names])
    pairs = data.contact.geom[: data.ncon]
    return bool((robot[pairs[:, 0]] != robot[pairs[:, 1]]).any()) if len(pairs) else False


def run(job: Job) -> Rollout:
    """Roll out one job with the environment that LIBERO itself would build."""
    import mujoco
    from support import upstream

    from vecenv.libero.tasks import suites

    spec = suites.task(job.suite, job.task)
    peer = upstream.bare_peer(spec.bddl_path)
    peer.seed(job.episode)
    with upstream.silence():
        peer.reset()
    model, data = upstream.model_of(peer), upstream.data_of(peer)
    bodies = {name: model.body(fixture.root_body) for name, fixture in peer.env.fixtures_dict.items()}
    start = spec.init_states()[job.episode].copy()
    start[1 + job.joint] += job.start_nudge
    peer.set_init_state(start)
    actions, rows = actions_of(job), []
    for action in actions:
        observation, _, done, _ = peer.step(action)
        turn = upstream.rotation_vector(observation["robot0_eef_quat"])
        state = np.concatenate([observation["robot0_eef_pos"], turn, observation["robot0_gripper_qpos"]])
        rows.append((data.qpos.copy(), data.qvel.copy(), state, bool(done), robot_touches(model, data)))
    qpos, qvel, state, success, touched = (np.array(column) for column in zip(*rows, strict=True))
    return Rollout(
        fixtures=np.array(list(bodies)),
        fixture_pos=np.array([body.pos for body in bodies.values()]).reshape(-1, 3),
        fixture_quat=np.array([body.quat for body in bodies.values()]).reshape(-1, 4),
        actions=actions,
        qpos=qpos,
        qvel=qvel,
        state=state,
        success=success,
        touched=np.maximum.accumulate(touched),
        mujoco=np.array(mujoco.__version__),
    )


def _rollouts(asked: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    arrays: dict[str, np.ndarray] = {}
    for number, job in enumerate(json.loads(str(asked["jobs"]))):
        rollout = run(Job(**job))
        arrays |= {f"{number}/{name}": getattr(rollout, name) for name in Rollout.__dataclass_fields__}
    return arrays


def _verdicts(asked: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    from support import upstream

    from vecenv.libero.tasks import suites

    spec = suites.task(str(asked["suite"]), int(asked["task"]))
    peer = upstream.peer_of(spec.bddl_path)
    upstream.set_fixtures(peer, asked["bodies"].tolist(), asked["pos"], asked["quat"])
    found, goal = [], spec.problem().goal
    for state in asked["states"]:
        upstream.set_state(peer, state, np.zeros(upstream.model_of(peer).nv))
        found.append(upstream.verdict(peer, goal))
    return {"verdicts": np.array(found, bool)}


def main() -> None:
    """Answer one question."""
    answers = {"rollouts": _rollouts, "verdicts": _verdicts}
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("question", choices=answers)
    parser.add_argument("asked", type=Path)
    parser.add_argument("made", type=Path)
    options = parser.parse_args()
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    with np.load(options.asked, allow_pickle=False) as file:
        arrays = answers[options.question]({name: file[name] for name in file.files})
    np.savez_compressed(options.made, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
