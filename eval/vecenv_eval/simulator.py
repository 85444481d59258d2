"""What the harness needs from a library of environments: a description of a suite, and a function that builds batches.

``vecenv_simulator`` is vecenv itself; tests put a small one of their own in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import vecenv
from vecenv import protocols
from vecenv.contract import BatchEnv
from vecenv.libero.render.options import ALIASES
from vecenv.libero.scene.arenas import ARENAS, camera_names
from vecenv.libero.tasks.suites import TaskSpec, list_tasks
from vecenv.simpler.config import CAMERAS as SIMPLER_CAMERAS
from vecenv.util.names import unknown
from vecenv_eval.config import ConfigError
from vecenv_eval.episodes import MAX_SLOTS, Suite

# A slot of SIMPLER is a PhysX scene of its own.
_SIMPLER_SLOTS = 50


@dataclass(frozen=True)
class Simulator:
    """The two functions the runner needs from a library of environments.

    Attributes:
        suite: describes a suite under a protocol, both by name, or raises ``ConfigError``.
        make: builds an environment, as ``vecenv.make`` does: ``tasks`` times ``episodes`` slots.
        check: raises a ``VecenvError`` for options that ``make`` would refuse, without building anything.
    """

    suite: Callable[[str, str], Suite]
    make: Callable[..., BatchEnv]
    check: Callable[[str, Mapping[str, object]], object] = lambda suite, options: None


def vecenv_simulator() -> Simulator:
    """``vecenv`` itself."""
    return Simulator(describe_suite, vecenv.make, vecenv.make_config)


def describe_suite(name: str, protocol: str = protocols.DEFAULT) -> Suite:
    """Describe one of ``vecenv``'s suites under a protocol.

    Raises:
        ConfigError: there is no suite or protocol of that name, or they do not go together.
    """
    suites = vecenv.list_suites()
    if name not in suites:
        raise ConfigError(unknown("suite", name, suites))
    try:
        per_task = vecenv.eval_metadata(name, protocol)["episodes_per_task"]
    except ValueError as error:
        raise ConfigError(str(error)) from error
    tasks = vecenv.list_tasks(name)
    simpler = vecenv.family(name) == protocols.SIMPLER
    return Suite(
        name=name,
        instructions=tuple(task.instruction for task in tasks),
        # SIMPLER's environments exchange scenes by themselves, so other tasks need no new environment.
        scenes=("",) * len(tasks) if simpler else tuple(task.problem().scene_key() for task in list_tasks(name)),
        # LIBERO has 50 starts of every task, whatever a protocol runs of them.
        num_episodes=per_task if simpler else max(per_task, vecenv.eval_metadata(name)["episodes_per_task"]),
        every=None if simpler else per_task,
        tasks=tuple(task.name for task in tasks),
        max_slots=_SIMPLER_SLOTS if simpler else MAX_SLOTS,
        cameras=(SIMPLER_CAMERAS,) * len(tasks) if simpler else tuple(map(_cameras, list_tasks(name))),
    )


def _cameras(task: TaskSpec) -> tuple[str, ...]:
    """Names of the cameras in the scene of a LIBERO task, and their aliases."""
    there = camera_names(ARENAS[task.problem().name])
    return (*there, *(alias for alias, name in ALIASES.items() if name in there))
