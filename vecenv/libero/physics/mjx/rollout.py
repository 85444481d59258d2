"""Loops over control steps of a batch of worlds: chunks of actions and plans of waypoints, without the host.

In: worlds with leaves [n, ...], their goals, and actions or plans. Out: the worlds afterwards, the control steps each
took and whether its goal held. Worlds stop one by one; a loop ends when none moves any more.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from vecenv.controllers import waypoint
from vecenv.libero.physics.mjx.blocks import by_blocks
from vecenv.libero.physics.mjx.model import System
from vecenv.libero.physics.mjx.options import is_deterministic
from vecenv.libero.physics.mjx.step import World, control_step, eef, judge
from vecenv.libero.scene import goals


class Loop(NamedTuple):
    """A batch whose worlds stop one by one.

    Attributes:
        worlds: the batch, leaves [n, ...].
        going: worlds that still move, bool [n].
        ticks: control steps taken, int [n].
        success: goal held after the last tick, bool [n].
        solved: goal held after one of the ticks, bool [n].
    """

    worlds: World
    going: jax.Array
    ticks: jax.Array
    success: jax.Array
    solved: jax.Array


def _tick(
    system: System,
    table: goals.GoalTable,
    limit: jax.Array,
    loop: Loop,
    actions: jax.Array,
    moved: jax.Array,
    until_success: bool,
) -> Loop:
    worlds = jax.vmap(control_step, in_axes=(None, 0, 0, 0))(system, loop.worlds, actions, moved)
    healthy = worlds.fault == 0
    held = jax.vmap(judge, in_axes=(None, 0, 0))(system, worlds, table)
    success = jnp.where(moved, held & healthy, loop.success)
    solved, ticks = loop.solved | success, loop.ticks + moved
    going = loop.going & healthy & (ticks < limit)
    return Loop(worlds, going & ~solved if until_success else going, ticks, success, solved)


def _begin(worlds: World, active: jax.Array, limit: jax.Array) -> Loop:
    none = jnp.zeros(active.shape, jnp.int32)
    return Loop(worlds, active & (limit > 0), none, jnp.zeros(active.shape, bool), jnp.zeros(active.shape, bool))


def run_chunk(
    system: System,
    table: goals.GoalTable,
    worlds: World,
    chunk: jax.Array,
    active: jax.Array,
    limit: jax.Array,
    *,
    until_success: bool = True,
) -> Loop:
    """Execute a chunk of actions, [n, K, 7].

    A world stops at its fault or limit, and at its success if ``until_success``; the loop ends when none moves.
    """

    def running(carry: tuple[Loop, jax.Array]) -> jax.Array:
        return carry[0].going.any() & (carry[1] < chunk.shape[1])

    def body(carry: tuple[Loop, jax.Array]) -> tuple[Loop, jax.Array]:
        loop, k = carry
        return _tick(system, table, limit, loop, chunk[:, k], loop.going, until_success), k + 1

    return lax.while_loop(running, body, (_begin(worlds, active, limit), jnp.zeros((), jnp.int32)))[0]


def _batched(system: System, function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of batches, [n, ...], which treats every world alike; computed by blocks if deterministic."""
    if not is_deterministic(system.model):
        return function
    return lambda *rows: by_blocks(lambda _, rows: function(*rows), (), rows)


class Trace(NamedTuple):
    """What ``follow_plan`` did in each of at most N ticks: ``actions`` [n, N, 7] and which worlds ``moved`` [n, N]."""

    actions: jax.Array
    moved: jax.Array


def follow_plan(
    system: System,
    table: goals.GoalTable,
    worlds: World,
    plan: waypoint.WaypointPlan,
    active: jax.Array,
    limit: jax.Array,
    max_misses: jax.Array,
    carried: jax.Array,
    *,
    sites: tuple[int, int],
    config: waypoint.WaypointConfig,
    traced: int = 0,
    until_success: bool = True,
) -> tuple[Loop, waypoint.Progress, Trace]:
    """Follow plans of waypoints; a world stops at the end of its plan, and at its own success, fault or limit.

    Args:
        system: what worlds share.
        table: goals, leading axis n.
        worlds: the batch.
        plan: T waypoints a world.
        active: worlds that take part, bool [n].
        limit: control steps each world may still take, int [n].
        max_misses: waypoints in a row that may time out before a world stops.
        carried: where the servo's references start, [n, 7]; at the end effectors in rows of NaN.
        sites: ids of the grip site and the hand body.
        config: tolerances and speeds.
        traced: ticks to record.
        until_success: whether a world stops at success.
    """
    progress = waypoint.begin_plan(plan, waypoint.start_reference(eef(worlds, *sites), carried))
    act = _batched(system, partial(waypoint.plan_action, config=config))
    advance = _batched(system, partial(waypoint.plan_advance, config=config))
    trace = Trace(jnp.zeros((*active.shape, traced, 7)), jnp.zeros((*active.shape, traced), bool))

    def moving(loop: Loop, progress: waypoint.Progress) -> jax.Array:
        return loop.going & waypoint.unfinished(plan, progress) & (progress.misses < max_misses)

    def body(
        carry: tuple[Loop, waypoint.Progress, Trace, jax.Array],
    ) -> tuple[Loop, waypoint.Progress, Trace, jax.Array]:
        loop, progress, trace, count = carry
        moved = moving(loop, progress)
        actions, progress = act(plan, progress, eef(loop.worlds, *sites), moved)
        loop = _tick(system, table, limit, loop, actions, moved, until_success)
        progress = advance(plan, progress, eef(loop.worlds, *sites), moved)
        if traced:
            trace = Trace(trace.actions.at[:, count].set(actions), trace.moved.at[:, count].set(moved))
        return loop, progress, trace, count + 1

    carry = (_begin(worlds, active, limit), progress, trace, jnp.zeros((), jnp.int32))
    loop, progress, trace, _ = lax.while_loop(lambda c: moving(c[0], c[1]).any(), body, carry)
    return loop, progress, trace
