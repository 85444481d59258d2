"""Batched robot-manipulation environments: the LIBERO and SIMPLER benchmarks behind one set of verbs.

``make`` returns an environment; ``vecenv.contract`` says what it promises. A suite's name comes in; which library
runs it is decided here, and only that one is imported.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vecenv.errors import InvalidInput, MissingDependency

if TYPE_CHECKING:
    from pathlib import Path

    from vecenv.contract import BatchEnv
    from vecenv.libero.physics.budgets import Budget
    from vecenv.libero.render.options import RenderConfig
    from vecenv.protocols import Protocol, ResetLoop
    from vecenv.simpler.variants import Variant

__version__ = "0.1.0"
__all__ = ["ExtraMissing", "OptionError", "eval_metadata", "list_suites", "list_tasks", "make"]

FAMILIES = ("libero", "simpler")
_SIMPLER = "simpler"
# What SIMPLER imports and the core does not need.
_SIMPLER_EXTRA = ("sapien", "ruckig", "trimesh", "PIL")


class OptionError(InvalidInput):
    """An option of ``make`` that this kind of suite does not have; the message names both."""


class ExtraMissing(MissingDependency):
    """A suite needs packages that are not installed; the message has the pip command."""


def make(
    suite: str,
    *,
    task: Any = None,
    tasks: Any = None,
    episodes: Any = None,
    protocol: str = "seed",
    backend: str = "native",
    max_steps: int | None = None,
    success: str | None = None,
    seed: int | None = None,
    num_threads: int | None = None,
    geometry: str = "exact",
    contacts: str = "published",
    fixtures: Any = None,
    reset_loop: ResetLoop | Mapping[str, Any] | None = None,
    start: str | None = None,
    settle_steps: int | None = None,
    num_devices: int = 1,
    budget: Budget | None = None,
    render: RenderConfig | None = None,
    scenes: str | Path | None = None,
    gripper: str = "native",
    overlay: str = "background",
    shadows: bool = False,
    variant: Variant | Mapping[str, Any] | None = None,
    assets: str | Path | None = None,
) -> BatchEnv:
    """A batch of episodes: every one of ``episodes`` of every one of ``tasks``, task by task, one a slot.

    Args:
        suite: one of ``list_suites()``.
        task: a single task: its index, or its name; in LIBERO also a part that only one name has.
        tasks: several tasks; all tasks of the suite when neither is given. In LIBERO also ``"0,3,5-7"``.
        episodes: as for ``vecenv eval``: ``"all"``, ``"5"`` for the first five, or ``"0,3,5-7"``; also a sequence of
            indices, or a mapping task index -> any of these. The protocol's by default, and no bare number.
        backend: ``"native"``: physics on the CPU, the suite's own simulator: MuJoCo on threads in float64 for LIBERO,
            SAPIEN's PhysX in worker processes (also called ``"physx_cpu"``) for SIMPLER. LIBERO only: ``"warp"``: MJX
            on MuJoCo Warp (NVIDIA GPUs; also runs on a CPU); ``"jax"``: MJX in pure JAX, any device; ``"mjx"``: warp on
            CUDA, jax elsewhere.
        protocol: the evaluation protocol that options come from where they are not given, ``max_steps``, ``success``,
            ``seed``, ``fixtures``, ``reset_loop``, ``start``, ``settle_steps``, ``episodes`` and the size of images
            among them; one of ``vecenv.protocols``. ``"seed"`` is this project's own: in LIBERO 2,500 ticks from
            settled starts, in SIMPLER seeds 2022 to 2071.
        max_steps: step budget in control ticks (LIBERO: 20 a second); SIMPLER's tasks have their own.
        success: ``"first"``: an episode ends when its goal first holds; ``"final"``: it goes on to the end of its
            budget, and the verdict is read there. ``evaluate`` reports both.
        seed: see ``fixtures``; SIMPLER's episodes depend on their number alone.
        num_threads: threads of LIBERO's native backend, worker processes of SIMPLER; None for one a core.
        geometry: LIBERO. ``"exact"``: the collision geometry of upstream. ``"lean"``: at most 24 fitted geoms a scene.
        contacts: LIBERO. ``"published"``: those of MuJoCo 2.3 to 3.3, under which LIBERO's data and checkpoints were
            made and scored. ``"current"``: those of the installed MuJoCo.
        fixtures: LIBERO. Where fixtures stand, which init states don't say: ``"center"`` of their region, ``"sampled"``
            from it (a function of seed, suite, task and episode), ``"upstream"``: where upstream's ``env.seed(seed)``
            and the resets of an evaluation script put them, or name -> (pos [3] or [B, 3], quat wxyz [4] or [B, 4]).
        reset_loop: LIBERO, for ``fixtures="upstream"``: how that script seeds and resets, a
            ``vecenv.protocols.ResetLoop`` or a mapping of its fields; seeded once a task, one reset an episode by
            default.
        start: LIBERO. ``"settled"``: init states at rest, as MuJoCo 3.3.0 settles them; ``"raw"``: init states as
            stored, followed by ``settle_steps``.
        settle_steps: LIBERO, for ``"raw"``: control ticks without motion, gripper opening, before an episode begins.
        num_devices: LIBERO. Devices that MJX spreads the slots over.
        budget: LIBERO. Contact and constraint memory on MJX; None measures each scene once and remembers it.
        render: LIBERO. Size, level of detail and colours of camera images, cameras of one's own; 256 x 256 and
            upstream's picture as LIBERO was published with by default. Nothing is rendered that is not read.
        scenes: LIBERO. A folder that ``vecenv compile`` wrote: tasks, starts and compiled scenes come from there, and
            no LIBERO or robosuite files are needed. Otherwise from the installed packages.
        gripper: SIMPLER. ``"native"``: the robot's own convention, WidowX +1 open and -1 closed, Google Robot +1 closes
            and -1 opens; ``"binary"``: 1 closed and 0 open. ``vecenv.actions`` has the table.
        overlay: SIMPLER. What replaces the background of pictures: ``"background"``, a photograph, as upstream's visual
            matching does; ``"none"``; or ``"blend"``, both at one half.
        shadows: SIMPLER. Whether lights cast shadows; upstream's do not.
        variant: SIMPLER. What differs from visual matching's scenes (light, camera, cabinet, table, distractors): a
            ``vecenv.simpler.variants.Variant`` or a mapping of its fields.
        assets: SIMPLER. Root of the asset tree; None for where ``vecenv assets pull simpler`` puts it
            (``VECENV_SIMPLER_ASSETS`` names another).

    Raises:
        OptionError: an option that suites of this kind do not have.
        ProtocolError: a protocol that they do not have.
        ExtraMissing: SIMPLER's packages are not installed.
        AssetsMissing: its files are not there.
        KeyError, ValueError, RuntimeError: subclasses that name the suite, task, option or asset that is wrong.
    """
    from vecenv import protocols

    chosen = protocols.protocol(protocol, family(suite))
    common = {"task": task, "tasks": tasks, "episodes": episodes, "backend": backend}
    given = {"max_steps": max_steps, "success": success}
    decided = chosen.options(suite) | {name: value for name, value in given.items() if value is not None}
    libero = {
        "geometry": (geometry, "exact"),
        "contacts": (contacts, "published"),
        "fixtures": (fixtures, None),
        "reset_loop": (reset_loop, None),
        "start": (start, None),
        "settle_steps": (settle_steps, None),
        "num_devices": (num_devices, 1),
        "budget": (budget, None),
        "render": (render, None),
        "scenes": (scenes, None),
    }
    simpler = {
        "gripper": (gripper, "native"),
        "overlay": (overlay, "background"),
        "shadows": (shadows, False),
        "variant": (variant, None),
        "assets": (assets, None),
    }
    if family(suite) == _SIMPLER:
        own: dict[str, Any] = {**decided, **_own(suite, simpler, libero)}
        if chosen.name != protocols.DEFAULT:
            own["protocol"] = chosen.name
        return _make_simpler(suite, {**common, "num_workers": num_threads, **own})
    own = {**decided, **({} if seed is None else {"seed": seed}), **_own(suite, libero, simpler)}
    from vecenv.libero import env

    return env.make(suite, protocol=chosen, **common, num_threads=num_threads, **own)


def _own(suite: str, own: Mapping[str, tuple[Any, Any]], foreign: Mapping[str, tuple[Any, Any]]) -> dict[str, Any]:
    """Those of a family's options that are not at their default; refuses the other family's."""
    strange = [f"{name}={value!r}" for name, (value, default) in foreign.items() if _given(value, default)]
    if strange:
        raise OptionError(f"{suite} has no option {', '.join(strange)}; its own: {', '.join(own)}")
    return {name: value for name, (value, default) in own.items() if _given(value, default)}


def _given(value: Any, default: Any) -> bool:
    return not (value is default or (type(value) is type(default) and value == default))


def _make_simpler(suite: str, options: dict[str, Any]) -> BatchEnv:
    from vecenv.simpler import tasks

    tasks.list_tasks(suite)  # an unknown suite is said before anything is missed
    missing = [name for name in _SIMPLER_EXTRA if importlib.util.find_spec(name) is None]
    if missing:
        needed = f"{suite} needs {', '.join(missing)}: pip install 'vecenv[simpler]'"
        raise ExtraMissing(f"{needed} (SAPIEN's wheels are for Python 3.11 and 3.12)", name=missing[0])
    from vecenv.simpler import env

    return env.make(suite, **options)


def family(suite: str) -> str:
    """Which benchmark a suite belongs to by its name: ``"simpler"`` for ``simpler/...``, else ``"libero"``."""
    return _SIMPLER if suite.split("/")[0] == _SIMPLER else "libero"


def _simpler_metadata(suite: str, protocol: Protocol) -> dict[str, Any]:
    """SIMPLER's metadata with the episodes that a protocol has of each task; 0 of those that it leaves out."""
    from vecenv.simpler.published.metadata import eval_metadata

    metadata = eval_metadata(suite)
    if protocol.episodes is not None:
        return metadata
    from vecenv.simpler.published import lists as published

    counts = published.counts(protocol.name, suite)
    per_task = tuple(counts.get(index, 0) for index in range(metadata["num_tasks"]))
    return {**metadata, "episodes_per_task": per_task, "num_episodes": sum(per_task)}


def list_suites(family: str | None = None) -> tuple[str, ...]:
    """Names of the suites: LIBERO's five, LIBERO-PRO's sixteen, SIMPLER's two.

    Args:
        family: ``"libero"`` (PRO's included) or ``"simpler"``; all when not given.

    Raises:
        OptionError: another family.
    """
    from vecenv.libero.tasks import suites
    from vecenv.simpler.tasks import SUITES

    known = {"libero": suites.list_suites(), _SIMPLER: SUITES}
    if family is None:
        return tuple(name for names in known.values() for name in names)
    if family not in known:
        raise OptionError(f"family={family!r}: expected one of {', '.join(known)}, or None for all suites")
    return known[family]


def list_tasks(suite: str) -> tuple[Any, ...]:
    """The tasks of a suite in upstream's order, each with an ``index``, a ``name`` and an ``instruction``.

    Returns:
        ``vecenv.libero.tasks.suites.TaskSpec`` or ``vecenv.simpler.task_spec.SimplerTask``, by the suite.

    Raises:
        KeyError: a subclass that lists the suites there are.
    """
    if family(suite) == _SIMPLER:
        from vecenv.simpler import tasks

        return tasks.list_tasks(suite)
    from vecenv.libero.tasks import suites

    return suites.list_tasks(suite)


def eval_metadata(suite: str, protocol: str = "seed") -> dict[str, Any]:
    """What an evaluation of a suite consists of: tasks, episodes, budget, metrics, instructions, and the protocol.

    ``max_steps`` is one number in LIBERO and one a task in SIMPLER, and so is ``episodes_per_task`` under a protocol
    whose tasks differ. ``protocol`` holds all that the protocol fixes (``vecenv.protocols.Protocol``). Needs neither
    SAPIEN nor SIMPLER's assets.

    Raises:
        KeyError: a subclass that lists the suites there are.
        ProtocolError: suites of this kind have no such protocol.
    """
    from vecenv import protocols

    chosen = protocols.protocol(protocol, family(suite))
    if family(suite) == _SIMPLER:
        return {**_simpler_metadata(suite, chosen), "protocol": chosen.to_dict()}
    from vecenv.libero.tasks import suites

    tasks = suites.list_tasks(suite)
    episodes = chosen.episodes or suites.NUM_EPISODES
    return {
        "suite": suite,
        "protocol": chosen.to_dict(),
        "num_tasks": len(tasks),
        "episodes_per_task": episodes,
        "num_episodes": len(tasks) * episodes,
        "max_steps": chosen.horizon_of(suite),
        "metrics": ("success", "num_steps", "cumulative_reward"),
        "action_space": ("step_continuous", "step_ee_pose"),
        "control_hz": 20,
        "instructions": tuple(task.instruction for task in tasks),
    }
