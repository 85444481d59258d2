"""Batched robot-manipulation environments: the LIBERO and SIMPLER benchmarks behind one set of verbs.

``make`` returns an environment; ``vecenv.contract`` says what it promises.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from vecenv.contract import BatchEnv
    from vecenv.libero.suites import TaskSpec
    from vecenv.physics.budgets import Budget
    from vecenv.render.options import RenderConfig

__version__ = "0.1.0"
__all__ = ["eval_metadata", "list_suites", "list_tasks", "make"]


def make(
    suite: str,
    *,
    task: Any = None,
    tasks: Any = None,
    episodes: Any = None,
    backend: str = "native",
    geometry: str = "exact",
    fixtures: Any = "center",
    start: str = "settled",
    settle_steps: int = 10,
    max_steps: int = 2500,
    seed: int = 0,
    num_threads: int | None = None,
    num_devices: int = 1,
    budget: Budget | None = None,
    render: RenderConfig | None = None,
    scenes: str | Path | None = None,
) -> BatchEnv:
    """A batch of episodes: every one of ``episodes`` of every one of ``tasks``, task by task, one a slot.

    Args:
        suite: one of ``list_suites()``.
        task: a single task index.
        tasks: several task indices; all tasks of the suite when neither is given.
        episodes: init states 0 to 49, one or several; or a mapping task -> init states. All 50 by default.
        backend: ``"native"``: MuJoCo on CPU threads, float64. ``"warp"``: MJX on MuJoCo Warp (NVIDIA GPUs; also runs on
            a CPU). ``"jax"``: MJX in pure JAX, any device. ``"mjx"``: warp on CUDA, jax elsewhere.
        geometry: ``"exact"``: the collision geometry of upstream. ``"lean"``: at most 24 fitted geoms a scene.
        fixtures: where fixtures stand, which init states don't say: ``"center"`` of their region, ``"sampled"`` from it
            (a function of seed, suite, task and episode), or name -> (pos [3] or [B, 3], quat wxyz [4] or [B, 4]).
        start: ``"settled"``: init states at rest, as MuJoCo 3.3.0 settles them (fixtures at the centre);
            ``"raw"``: init states as stored, followed by ``settle_steps``.
        settle_steps: for ``"raw"``: control ticks without motion, gripper opening, before an episode begins.
        max_steps: step budget in control ticks (20 a second).
        seed: see ``fixtures``.
        num_threads: threads of the native backend; None for one a core.
        num_devices: devices that MJX spreads the slots over.
        budget: contact and constraint memory on MJX; None measures each scene once and remembers it.
        render: size and level of detail of camera images, cameras of one's own; 256 x 256 and upstream's picture by
            default. Nothing is rendered that is not read.
        scenes: a folder that ``vecenv compile`` wrote: tasks, starts and compiled scenes come from there, and no
            LIBERO or robosuite files are needed. Otherwise from the installed packages.

    Raises:
        KeyError, ValueError, RuntimeError: subclasses that name the suite, task, option or asset that is wrong.
    """
    from vecenv.libero import env

    return env.make(
        suite,
        task=task,
        tasks=tasks,
        episodes=episodes,
        backend=backend,
        geometry=geometry,
        fixtures=fixtures,
        start=start,
        settle_steps=settle_steps,
        max_steps=max_steps,
        seed=seed,
        num_threads=num_threads,
        num_devices=num_devices,
        budget=budget,
        scenes=scenes,
        **({} if render is None else {"render": render}),
    )


def list_suites() -> tuple[str, ...]:
    """Names of the suites: LIBERO's five, then LIBERO-PRO's sixteen."""
    from vecenv.libero import suites

    return suites.list_suites()


def list_tasks(suite: str) -> tuple[TaskSpec, ...]:
    """The tasks of a suite in upstream's order."""
    from vecenv.libero import suites

    return suites.list_tasks(suite)


def eval_metadata(suite: str) -> dict[str, Any]:
    """What an evaluation of a suite consists of: tasks, episodes, budget, metrics, instructions."""
    from vecenv.libero import suites
    from vecenv.libero.env import MAX_STEPS

    tasks = suites.list_tasks(suite)
    return {
        "suite": suite,
        "num_tasks": len(tasks),
        "episodes_per_task": suites.NUM_EPISODES,
        "num_episodes": len(tasks) * suites.NUM_EPISODES,
        "max_steps": MAX_STEPS,
        "metrics": ("success", "num_steps", "cumulative_reward"),
        "action_space": ("step_continuous", "step_ee_pose"),
        "control_hz": 20,
        "instructions": tuple(task.instruction for task in tasks),
    }
