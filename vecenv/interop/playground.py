"""LIBERO tasks as MuJoCo Playground environments, for its registry, its wrappers and Brax's trainers.

In: a name such as ``"Libero/libero_object/0"``. Out: an ``MjxEnv`` whose ``reset`` and ``step`` are those of
``vecenv.libero.functional``. ``register`` puts all 290 tasks (LIBERO's 130 and LIBERO-PRO's 160) into Playground's
registry without reading any of them.

Playground's training wrapper begins each later episode of a world in the state of its first one, unless
``full_reset=True``; ``wrap_for_training`` is that wrapper with full resets, so starts rotate::

    env = playground.load("Libero/libero_object/0", config_overrides={"objective": "reach", "reward": "shaped"})
    ppo.train(environment=env, wrap_env_fn=playground.wrap_for_training, episode_length=100, ...)

A full reset costs one more evaluation of kinematics and contacts a step, beside the 25 of the step itself.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from vecenv.libero import functional
from vecenv.libero.functional import FunctionalConfig, FunctionalError, randomize
from vecenv.libero.tasks.suites import list_suites, list_tasks

try:
    from ml_collections import config_dict
    from mujoco_playground import MjxEnv, dm_control_suite, registry, render_array, wrapper
except ImportError as error:
    raise ImportError("vecenv.interop.playground needs MuJoCo Playground: pip install 'vecenv[train]'") from error

__all__ = [
    "PlaygroundEnv",
    "default_config",
    "env_names",
    "load",
    "mend_brax",
    "randomize",
    "register",
    "wrap_for_training",
]

PREFIX = "Libero"
_SIM_DT, _CTRL_DT = 0.002, 0.05


def wrap_for_training(env: Any, **options: Any) -> Any:
    """Playground's ``wrap_for_brax_training`` with full resets, so that every episode begins in a start of its own.

    Args:
        env: the environment.
        options: as for ``wrap_for_brax_training``.
    """
    mend_brax()
    return wrapper.wrap_for_brax_training(env, **{"full_reset": True, **options})


def mend_brax() -> None:
    """Make Brax's trainers run on JAX 0.10, which no longer has a function they call (google/brax, issue 671).

    Where ``jax.device_put_replicated`` is missing, one is put in its place; otherwise nothing happens.
    ``wrap_for_training`` does this; call it yourself before training with another wrapper.
    """
    if not hasattr(jax, "device_put_replicated"):
        jax.device_put_replicated = _replicated


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy of every leaf on every device, along a new leading axis."""
    sharding = NamedSharding(Mesh(np.array(devices), ("device",)), PartitionSpec("device"))
    return jax.tree.map(lambda leaf: jax.device_put(jnp.stack([leaf] * len(devices)), sharding), tree)


def default_config() -> config_dict.ConfigDict:
    """The options of ``FunctionalConfig`` with their defaults, and what Playground's scripts read.

    ``ctrl_dt`` and ``sim_dt`` are for information: a LIBERO step is 25 substeps of 2 ms.
    """
    defaults = FunctionalConfig()
    options = {field.name: getattr(defaults, field.name) for field in dataclasses.fields(defaults)}
    # Several options take values of different types; FunctionalConfig checks them.
    return config_dict.ConfigDict(
        {**options, "action_repeat": 1, "ctrl_dt": _CTRL_DT, "sim_dt": _SIM_DT}, type_safe=False
    )


class PlaygroundEnv(functional.FunctionalLibero, MjxEnv):
    """A LIBERO task as Playground's ``MjxEnv``.

    Args:
        suite, task: which task.
        config: options; None for ``default_config()``.
        config_overrides: options that replace those of ``config``.

    Raises:
        FunctionalError: an option that cannot be honoured; and what ``functional.FunctionalLibero`` raises.
    """

    def __init__(
        self,
        suite: str,
        task: int,
        config: config_dict.ConfigDict | None = None,
        config_overrides: Mapping[str, Any] | None = None,
    ) -> None:
        self._config = (config or default_config()).copy_and_resolve_references().lock()
        self._config.update_from_flattened_dict(dict(config_overrides or {}))
        if (self._config.ctrl_dt, self._config.sim_dt) != (_CTRL_DT, _SIM_DT):
            raise FunctionalError(f"a LIBERO step is {_CTRL_DT} s in substeps of {_SIM_DT} s; that cannot be changed")
        functional.FunctionalLibero.__init__(self, suite, task=task, config=_functional(self._config))

    def render(self, trajectory: Any, *args: Any, **options: Any) -> Any:
        """Images of the collision geometry, which is all that the physics model has.

        Args:
            trajectory: a list of states of one episode of one world, or one state.
            args, options: as for ``mujoco_playground.render_array`` after the trajectory.
        """
        first = trajectory[0] if isinstance(trajectory, list) else trajectory
        model = copy.copy(self.mj_model)
        model.body_pos[:], model.body_quat[:] = first.data.world.body_pos, first.data.world.body_quat
        return render_array(model, trajectory, *args, **options)


def _functional(config: config_dict.ConfigDict) -> FunctionalConfig:
    options: dict[str, Any] = dict(config.items())
    names = [field.name for field in dataclasses.fields(FunctionalConfig)]
    return FunctionalConfig(**{name: options[name] for name in names if name in options})


def env_names(suites: Iterable[str] | None = None) -> tuple[str, ...]:
    """Names of the tasks of some suites, all by default: ``"Libero/<suite>/<task>"``.

    Raises:
        UnknownSuite: no such suite.
    """
    chosen = list_suites() if suites is None else tuple(suites)
    return tuple(f"{PREFIX}/{suite}/{task}" for suite in chosen for task in range(len(list_tasks(suite))))


def register(suites: Iterable[str] | None = None) -> tuple[str, ...]:
    """Make ``mujoco_playground.registry`` know the tasks of some suites, all by default; doing it twice is harmless.

    They go to the part of the registry whose ``load`` downloads nothing.

    Returns:
        Their names.
    """
    names = env_names(suites)
    for name in names:
        dm_control_suite.register_environment(name, cast(Any, _maker(name)), default_config)
    registry.ALL_ENVS = tuple(dict.fromkeys((*registry.ALL_ENVS, *names)))
    return names


def load(
    name: str,
    config: config_dict.ConfigDict | None = None,
    config_overrides: Mapping[str, Any] | None = None,
) -> PlaygroundEnv:
    """The environment of this name, registered or not.

    Raises:
        FunctionalError: not the name of a task; and what ``PlaygroundEnv`` raises.
    """
    return _maker(name)(config=config, config_overrides=config_overrides)


def _maker(name: str) -> Callable[..., PlaygroundEnv]:
    match name.split("/"):
        case [prefix, suite, task] if prefix == PREFIX and task.isdecimal():
            return functools.partial(PlaygroundEnv, suite, int(task))
    raise FunctionalError(f"{name!r}: expected {PREFIX}/<suite>/<task>, for example {PREFIX}/libero_object/0")
