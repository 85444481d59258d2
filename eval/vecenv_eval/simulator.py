"""What the harness needs from a library of environments: a description of a suite, and a function that builds batches.

``vecenv_simulator`` is vecenv itself; tests put a small one of their own in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import vecenv
from vecenv import protocols
from vecenv.contract import BatchEnv
from vecenv.errors import VecenvError
from vecenv.libero.render.options import ALIASES
from vecenv.libero.scene.arenas import ARENAS, camera_names
from vecenv.libero.tasks.export import exported_tasks
from vecenv.libero.tasks.sources import Task, installed_tasks
from vecenv.libero.tasks.suites import NUM_EPISODES
from vecenv.simpler.config import CAMERAS as SIMPLER_CAMERAS
from vecenv.util.names import unknown
from vecenv_eval.config import ConfigError, EvalConfig
from vecenv_eval.episodes import MAX_SLOTS, Suite

# A slot of SIMPLER is a PhysX scene of its own.
_SIMPLER_SLOTS = 50


@dataclass(frozen=True)
class Simulator:
    """The functions the runner needs from a library of environments.

    Attributes:
        suite: describes a suite under a protocol, both by name, or raises ``ConfigError``.
        make: builds an environment, as ``vecenv.make`` does: ``tasks`` times ``episodes`` slots.
        check: raises a ``VecenvError`` for options that ``make`` would refuse, without building anything.
        exported: as ``suite``, of a suite in an exported folder; None where there are no such folders.
    """

    suite: Callable[[str, str], Suite]
    make: Callable[..., BatchEnv]
    check: Callable[[str, Mapping[str, object]], object] = lambda suite, options: None
    exported: Callable[[str, str, str], Suite] | None = None

    def suite_of(self, config: EvalConfig) -> Suite:
        """The suite that a config names, read from its exported folder if it has one.

        Raises:
            ConfigError: there is no such suite, protocol or folder, or they do not go together.
        """
        scenes = config.env_args.get("scenes")
        if scenes is None or self.exported is None:
            return self.suite(config.suite, config.protocol)
        return self.exported(config.suite, config.protocol, str(scenes))


def vecenv_simulator() -> Simulator:
    """``vecenv`` itself."""
    return Simulator(describe_suite, vecenv.make, vecenv.make_config, describe_exported)


def describe_suite(name: str, protocol: str = protocols.DEFAULT) -> Suite:
    """Describe one of ``vecenv``'s suites under a protocol.

    Raises:
        ConfigError: there is no suite or protocol of that name, or they do not go together.
    """
    is_simpler = _family(name) == protocols.SIMPLER
    try:
        if not is_simpler:
            return _libero(name, protocol, installed_tasks(name))
        per_task = vecenv.eval_metadata(name, protocol)["episodes_per_task"]
    except ValueError as error:
        raise ConfigError(str(error)) from error
    tasks = vecenv.list_tasks(name)
    return Suite(
        name=name,
        instructions=tuple(task.instruction for task in tasks),
        # Environments exchange scenes by themselves, so other tasks need no new environment.
        scenes=("",) * len(tasks),
        num_episodes=per_task,
        tasks=tuple(task.name for task in tasks),
        max_slots=_SIMPLER_SLOTS,
        cameras=(SIMPLER_CAMERAS,) * len(tasks),
    )


def describe_exported(name: str, protocol: str, folder: str) -> Suite:
    """Describe a LIBERO suite that ``vecenv compile`` wrote into a folder; the LIBERO packages are not read.

    Raises:
        ConfigError: there is no such suite, protocol or folder, or they do not go together.
    """
    if _family(name) == protocols.SIMPLER:
        raise ConfigError(f"scenes={folder}: {name} is of SIMPLER, whose scenes are not exported")
    try:
        return _libero(name, protocol, exported_tasks(folder, name))
    except (VecenvError, ValueError) as error:
        raise ConfigError(str(error)) from error


def _family(name: str) -> str:
    suites = vecenv.list_suites()
    if name not in suites:
        raise ConfigError(unknown("suite", name, suites))
    return vecenv.family(name)


def _libero(name: str, protocol: str, tasks: Sequence[Task]) -> Suite:
    """A suite of these tasks; errors of a protocol that does not exist or says nothing about it."""
    chosen = protocols.protocol(protocol, protocols.LIBERO)
    chosen.horizon_of(name)
    per_task = chosen.episodes or NUM_EPISODES
    return Suite(
        name=name,
        instructions=tuple(task.instruction for task in tasks),
        scenes=tuple(task.problem().scene_key() for task in tasks),
        # There are 50 starts of every task, whatever a protocol runs of them.
        num_episodes=max(per_task, NUM_EPISODES),
        every=per_task,
        tasks=tuple(task.name for task in tasks),
        max_slots=MAX_SLOTS,
        cameras=tuple(map(_cameras, tasks)),
    )


def _cameras(task: Task) -> tuple[str, ...]:
    """Names of the cameras in the scene of a LIBERO task, and their aliases."""
    there = camera_names(ARENAS[task.problem().name])
    return (*there, *(alias for alias, name in ALIASES.items() if name in there))
