"""``vecenv bench``: benchmarks against upstream; each prints one table, ratio first."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import typer

from vecenv.cli import fail

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

bench_app = typer.Typer(no_args_is_help=True, help="Benchmarks; each prints one table, ratio first.")


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
    from vecenv_eval.bench import physics
    from vecenv_eval.bench.table import publish

    chosen = [_scene(text) for text in scene] if scene else list(SCENES)
    cores = usable_cores()
    rows = []
    for suite, task in chosen:
        if sweep:
            rows += physics.sweep(suite, task, seconds=seconds, cores=cores, on_row=_echo)
        else:
            shared = {"rounds": rounds, "seconds": seconds, "num_envs": num_envs, "cores": cores}
            rows.append(physics.compare_scene(suite, task, **shared))
            _echo(rows[-1])
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
    from vecenv.util.cores import usable_cores
    from vecenv_eval.bench.suite import compare_suite
    from vecenv_eval.bench.table import publish

    cores = usable_cores()
    publish([compare_suite(suite, episodes, policy, cores)], f"{policy} on {suite}, wall seconds, {cores} cores", out)


def _scene(text: str) -> tuple[str, int]:
    suite, _, task = text.rpartition("/")
    if not suite or not task.isdigit():
        fail(f"--scene {text}: expected suite/task, such as libero_object/0")
    return suite, int(task)


def _echo(row: Mapping[str, object]) -> None:
    typer.echo(json.dumps(row), err=True)
