"""Batched robot-manipulation environments: the LIBERO and SIMPLER benchmarks behind one set of verbs.

``make`` returns an environment; ``vecenv.contract`` says what it promises. ``vecenv.registry`` knows which package runs
a suite, and only that one is imported.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from numbers import Integral
from typing import TYPE_CHECKING, Any

from vecenv import registry
from vecenv.errors import VecenvError
from vecenv.registry import ExtraMissing, OptionError, TaskInfo
from vecenv.util.names import shown

if TYPE_CHECKING:
    from vecenv.contract import BatchEnv
    from vecenv.libero.config import LiberoConfig
    from vecenv.libero.render.options import RenderConfig
    from vecenv.simpler.config import SimplerConfig

__version__ = "0.2.0.dev0"
__all__ = [
    "ExtraMissing",
    "LiberoConfig",
    "OptionError",
    "RenderConfig",
    "SimplerConfig",
    "VecenvError",
    "eval_metadata",
    "family",
    "list_suites",
    "list_tasks",
    "make",
    "make_config",
]

# Imported when they are asked for: they bring MuJoCo or SciPy with them.
_LATER: Mapping[str, str] = {
    "LiberoConfig": "vecenv.libero.config",
    "RenderConfig": "vecenv.libero.render.options",
    "SimplerConfig": "vecenv.simpler.config",
}


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_LATER[name]), name)


def make(
    suite: str,
    *,
    task: int | str | None = None,
    tasks: object = None,
    episodes: object = None,
    config: LiberoConfig | SimplerConfig | None = None,
    **fields: object,
) -> BatchEnv:
    """A batch of episodes: every one of ``episodes`` of every one of ``tasks``, task by task, one a slot.

    Options are the fields of the family's config, ``LiberoConfig`` or ``SimplerConfig``, which document them and hold
    their defaults: ``make("libero_goal", task=3, backend="warp", geometry="lean", render={"lod": "fast"})``. An option
    that is not given is decided by the evaluation protocol (``protocol=``, see ``vecenv.protocols``) or has its
    default.

    Args:
        suite: one of ``list_suites()``.
        task: a single task: its index, or its name; in LIBERO also a part that only one name has.
        tasks: several tasks; all tasks of the suite when neither is given. In LIBERO also ``"0,3,5-7"``.
        episodes: as for ``vecenv eval``: ``"all"``, ``"5"`` for the first five, or ``"0,3,5-7"``; also a sequence of
            indices, or a mapping task index -> any of these. The protocol's by default, and no bare number.
        config: options to start from; ``fields`` replace some of them.
        **fields: options by their name; a nested config may be a mapping of its fields.

    Raises:
        OptionError: an option that suites of this kind do not have, or a value of a wrong type.
        ProtocolError: a protocol that they do not have.
        ExtraMissing: SIMPLER's packages are not installed.
        AssetsMissing: its files are not there.
        KeyError, ValueError, RuntimeError: subclasses that name the suite, task, option or asset that is wrong.
    """
    if task is not None and tasks is not None:
        raise OptionError("give task or tasks, not both")
    if not (task is None or isinstance(task, str) or (isinstance(task, Integral) and not isinstance(task, bool))):
        raise OptionError(f"task={shown(task)}: expected an index or a name; several go into tasks")
    made = make_config(suite, fields, config)
    return registry.family_of(suite).make(suite, tasks if task is None else task, episodes, made)


def make_config(
    suite: str, fields: Mapping[str, object], config: LiberoConfig | SimplerConfig | None = None
) -> LiberoConfig | SimplerConfig:
    """The options that ``make`` would build an environment with; nothing is built.

    Args:
        suite: one of ``list_suites()``.
        fields: options by their name.
        config: options to start from; None for the defaults.

    Raises:
        OptionError: an option that suites of this kind do not have, or a value of a wrong type.
        KeyError, ValueError: subclasses that name the suite or the value that is wrong.
    """
    from vecenv.util import configs

    chosen = registry.family_of(suite)
    if suite not in chosen.list_suites():
        chosen.list_tasks(suite)  # raises the error that names the known suites
    kind = chosen.config_type()
    if config is not None and not isinstance(config, kind):
        raise OptionError(f"{suite}: config is a {type(config).__name__}, expected {kind.__name__}")
    return configs.build(kind, fields, config, what=suite, error=OptionError)


def family(suite: str) -> str:
    """Which benchmark a suite belongs to by its name: ``"simpler"`` for ``simpler/...``, else ``"libero"``."""
    return registry.family_name(suite)


def list_suites(family: str | None = None) -> tuple[str, ...]:
    """Names of the suites: LIBERO's five, LIBERO-PRO's sixteen, SIMPLER's two.

    Args:
        family: ``"libero"`` (PRO's included) or ``"simpler"``; all when not given.

    Raises:
        OptionError: another family.
    """
    if family is not None:
        return registry.family(family).list_suites()
    return tuple(name for each in registry.FAMILIES for name in registry.family(each).list_suites())


def list_tasks(suite: str) -> tuple[TaskInfo, ...]:
    """The tasks of a suite in upstream's order, each with an ``index``, a ``name`` and an ``instruction``.

    Returns:
        ``vecenv.libero.tasks.suites.TaskSpec`` or ``vecenv.simpler.task_spec.SimplerTask``, by the suite.

    Raises:
        KeyError: a subclass that lists the suites there are.
    """
    return tuple(registry.family_of(suite).list_tasks(suite))


def eval_metadata(suite: str, protocol: str = "seed") -> dict[str, Any]:
    """What an evaluation of a suite consists of: tasks, episodes, budget, metrics, instructions, and the protocol.

    ``max_steps`` is one number in LIBERO and one a task in SIMPLER, and so is ``episodes_per_task`` under a protocol
    whose tasks differ. ``protocol`` holds all that the protocol fixes (``vecenv.protocols.Protocol``). Needs neither
    SAPIEN nor SIMPLER's assets.

    Raises:
        KeyError: a subclass that lists the suites there are.
        ProtocolError: suites of this kind have no such protocol.
    """
    return registry.family_of(suite).eval_metadata(suite, protocol)
