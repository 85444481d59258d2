"""The compiled functions of one scene: create, start, overwrite and step its worlds, on one device or several.

In: a ``Build`` and the devices. Out: functions of whole batches, leaves [n, ...], each compiled when it is first
called.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from mujoco import mjx

from vecenv.controllers import waypoint
from vecenv.libero.physics.mjx.model import Build, System
from vecenv.libero.physics.mjx.options import jit
from vecenv.libero.physics.mjx.rollout import Loop, Trace, follow_plan, run_chunk
from vecenv.libero.physics.mjx.step import (
    STATE,
    UNSTABLE,
    World,
    cleared,
    forward,
    is_stable,
    new_world,
    observe,
    start_world,
)
from vecenv.libero.scene import goals
from vecenv.util.devices import Spread


class ScenePrograms:
    """The compiled functions of one scene.

    With several devices, each runs its share of the worlds independently: nothing is exchanged, and a loop over ticks
    ends on a device when its own worlds have stopped.

    Args:
        built: the scene.
        mesh: the devices, one axis; None for the default device.
    """

    def __init__(self, built: Build, mesh: Mesh | None) -> None:
        self._mesh = mesh
        self._sites = (built.scene.grip_site, built.scene.hand_body)
        self.create = self._compile(_create, shared=2)
        self.start = self._compile(_start)
        self.write = self._compile(_write)
        self.forward = self._compile(jax.vmap(forward, in_axes=(None, 0)))
        self._run = {
            mode: self._compile(functools.partial(run_chunk, until_success=mode), donate_argnums=(2,))
            for mode in (True, False)
        }
        self._follow: dict[Any, Callable[..., Any]] = {}

    def run(self, until_success: bool) -> Callable[..., Any]:
        """``run_chunk``, which stops a world at success or not."""
        return self._run[until_success]

    def follow(self, config: waypoint.WaypointConfig, traced: int, until_success: bool) -> Callable[..., Any]:
        """``follow_plan`` with these settings."""
        key = (config, traced, until_success)
        if key not in self._follow:
            settings = {"config": config, "traced": traced, "until_success": until_success}
            function = functools.partial(_follow, sites=self._sites, **settings)
            self._follow[key] = self._compile(function, shared=2, donate_argnums=(3,))
        return self._follow[key]

    def _compile(self, function: Callable[..., Any], *, shared: int = 1, **options: Any) -> Callable[..., Any]:
        """Jit a function whose first ``shared`` arguments are the same for all worlds."""
        compiled = jit(function, **options)
        return compiled if self._mesh is None else Spread(compiled, self._mesh, shared)


@functools.lru_cache(maxsize=64)
def programs_of(built: Build, mesh: Mesh | None) -> ScenePrograms:
    """The programs of a scene on these devices, the same object each time; None for the default device."""
    return ScenePrograms(built, mesh)


def _create(system: System, blank: mjx.Data, qpos: jax.Array) -> World:
    """Worlds at these positions, [n, nq]."""
    return jax.vmap(lambda row: new_world(system, blank.replace(qpos=row)))(qpos)


def _start(
    system: System, worlds: World, mask: jax.Array, bodies: tuple[jax.Array, jax.Array], start: tuple[Any, ...]
) -> World:
    """Begin episodes in the worlds of the mask, bool [n]."""
    pos = jnp.where(mask[:, None, None], bodies[0], worlds.body_pos)
    quat = jnp.where(mask[:, None, None], bodies[1], worlds.body_quat)
    placed = worlds._replace(body_pos=pos, body_quat=quat)
    fresh = jax.vmap(start_world, in_axes=(None, 0, 0, 0, 0, 0))(system, placed, *start)
    return _merge(mask, fresh, worlds)


def _write(system: System, worlds: World, qpos: jax.Array, qvel: jax.Array, time: jax.Array) -> World:
    """Overwrite the state of every world."""

    def one(world: World, qpos: jax.Array, qvel: jax.Array, time: jax.Array) -> World:
        data = cleared(world.data, qpos, qvel, time)
        written = world._replace(data=forward(system, world._replace(data=data)))
        written = written._replace(fault=jnp.where(is_stable(written.data), 0, UNSTABLE).astype(jnp.int32))
        return observe(system, written)

    return jax.vmap(one)(worlds, qpos, qvel, time)


def _follow(
    system: System,
    max_misses: jax.Array,
    table: goals.GoalTable,
    worlds: World,
    plan: waypoint.WaypointPlan,
    active: jax.Array,
    limit: jax.Array,
    carried: jax.Array,
    **options: Any,
) -> tuple[Loop, waypoint.Progress, Trace]:
    return follow_plan(system, table, worlds, plan, active, limit, max_misses, carried, **options)


def _merge(mask: jax.Array, new: World, old: World) -> World:
    """``new`` where the mask, bool [n], holds. Of the data only the state counts; a step computes the rest."""

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.where(mask.reshape(-1, *[1] * (a.ndim - 1)), a, b)

    small = jax.tree.map(choose, new._replace(data=None), old._replace(data=None))
    kept = {name: choose(getattr(new.data, name), getattr(old.data, name)) for name in STATE}
    return small._replace(data=new.data.replace(**kept))
