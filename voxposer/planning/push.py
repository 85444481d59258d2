# ruff: noqa: F722  (shapes in annotations)
"""Pushing: the push that moves an object closest to its goal, and the hand's waypoints for it.

In, for each slot: the object's surface points and the goal of its centre, world frame, metres. Out: ``Push``
(where to touch, which way, how far), and from it poses for the hand, closed, slanted, kept above the table.

This is the model-predictive control of VoxPoser's object-centric subtasks (huangwl18/VoxPoser @ e3a4c9e,
``controllers.py`` and ``dynamics_models.py``): sample thousands of pushes, predict each with a model in which the
object moves along with the hand, take the best, push, observe again. Upstream moves a copy of the whole cloud for each
sample and then takes its mean. A translation moves the mean equally, so here a sample takes only a few operations and
the costs are the same.

What hangs on a joint (a drawer, a door, a handle) moves only as the joint lets it: its pushes go along the way that
each point moves (``ways``), and the model moves its centre along the joint, not along with the hand.

Three points differ, to suit a real hand. Pushing from further back on the same line predicts the same, so the
chosen contact is moved to where the hand, coming from behind, first touches. By default directions are level: a hand on
its way to a target a centimetre lower would press on the table. And by default no distance is negative: upstream's
model lets a hand beyond the target pull the object back by 2 cm, which a closed hand cannot do.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num, Shaped

from vecenv.util.rotations import mat_to_quat, quat_mul, safe_norm
from voxposer.planning.maps import AnyArray

# Closer than this a contact has no direction to the target.
_NO_WAY = 1e-6
# The hand's orientation above the table with which the Panda starts.
HAND_DOWN = (0.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class PushConfig:
    """Numbers of the search and of the hand's motion; metres.

    Attributes:
        num_samples: pushes tried per call.
        min_distance: shortest push tried; upstream's is -0.02, and a negative push pulls the object towards the hand.
        max_distance: longest push tried.
        level: push horizontally, and judge by the horizontal distance to the target. False is upstream's way.
        hand_width: of the closed hand, across the push; the contact is the first point of the object within it.
        start_distance: how far before the contact the push starts.
        retreat: share of ``start_distance`` to which the hand draws back after it.
        lift: how far above start and end the hand comes and goes.
        slant: of the fingers from the vertical, towards the push, radians.
        tip: how far the fingers reach below the contact.
        push_speed: share of the free speed while touching.
        retreat_speed: share of the free speed while drawing back.

    Raises:
        ValueError: naming what is out of range.
    """

    num_samples: int = 10_000
    min_distance: float = 0.0
    max_distance: float = 0.09
    level: bool = True
    hand_width: float = 0.04
    start_distance: float = 0.08
    retreat: float = 0.8
    lift: float = 0.12
    slant: float = np.pi / 4
    tip: float = 0.0095
    push_speed: float = 0.2
    retreat_speed: float = 0.33

    def __post_init__(self) -> None:
        if self.num_samples < 1:
            raise ValueError(f"num_samples must be at least 1, got {self.num_samples}")
        if not self.min_distance <= self.max_distance:
            raise ValueError(f"min_distance {self.min_distance} exceeds max_distance {self.max_distance}")


class Push(NamedTuple):
    """The best of the sampled pushes of each slot, world frame.

    Attributes:
        contact: where the hand touches, [B, 3].
        direction: unit vector, [B, 3]; zero where the object is at its target or has no points.
        distance: length of the push, metres, [B].
        cost: predicted distance of the object's centre from the target, [B]; infinite without points.
        predicted: where the model expects the centre, [B, 3].
    """

    contact: Float[Array, "B 3"]
    direction: Float[Array, "B 3"]
    distance: Float[Array, " B"]
    cost: Float[Array, " B"]
    predicted: Float[Array, "B 3"]


class PushWaypoints(NamedTuple):
    """The hand's way through a push: above the start, start, end of the push, drawn back, above that.

    Attributes:
        pose: xyz + wxyz of the hand, [B, 5, 7].
        grip: 1 (closed), [B, 5].
        velocity: share of the free speed on the way to each, [B, 5].
    """

    pose: Float[Array, "B 5 7"]
    grip: Float[Array, "B 5"]
    velocity: Float[Array, "B 5"]


@partial(jax.jit, static_argnames="config")
def best_push(
    points: Num[AnyArray, "B M 3"],
    target: Num[AnyArray, "B 3"],
    key: Shaped[Array, ...],
    config: PushConfig = PushConfig(),
    *,
    valid: Bool[AnyArray, "B M"] | None = None,
    normals: Num[AnyArray, "B M 3"] | None = None,
    touchable: Shaped[AnyArray, "B M"] | None = None,
    lowest: Num[AnyArray, " B"] | Num[AnyArray, ""] | float | None = None,
    highest: Num[AnyArray, " B"] | Num[AnyArray, ""] | float | None = None,
    ways: Num[AnyArray, "B M 3"] | None = None,
    carried: Num[AnyArray, "B M 3"] | None = None,
) -> Push:
    """The push that is predicted to bring each object's centre closest to its target.

    Args:
        points: surface of the object, metres, [B, M, 3].
        target: where its centre (the mean of its points) should come to be, [B, 3].
        key: one ``jax.random`` key, or one a slot, [B]: then a slot's push does not depend on the batch it is in.
        config: numbers of the search.
        valid: bool [B, M], False for padding; None for no padding. Points that are not finite are left out as well.
        normals: outward normals of the surface, [B, M, 3]. With normals, a push moves the object if it is
            directed against the face that it touches, the inside of a rim for example; without, if it is not directed
            away from the centre (upstream's rule, right for convex objects).
        touchable: bool [B, M], points that the hand can come to; None for all. Where there are none, all count.
        lowest: world height below which the hand must not touch, [B] or a number: the table and some clearance.
        highest: world height above which it must not, [B] or a number. Where no point lies between, the contact is
            moved to the nearest height allowed.
        ways: of what hangs on a joint, the direction in which the joint moves each point towards the target, unit
            vectors, [B, M, 3]; zero, or None, for what is free: a push of it goes towards the target.
        carried: with ``ways``, how far its centre moves for each metre that a point is pushed, [B, M, 3].

    Returns:
        A push for each slot.

    Raises:
        ValueError: shapes that don't fit together.
    """
    points, target = jnp.asarray(points), jnp.asarray(target)
    if points.ndim != 3 or points.shape[-1] != 3 or target.shape != (len(points), 3):
        raise ValueError(f"points and target must be [B, M, 3] and [B, 3], got {points.shape} and {target.shape}")
    slots = len(points)
    low, high = (_heights(limit, default, slots) for limit, default in ((lowest, -jnp.inf), (highest, jnp.inf)))
    usable, free = _usable_and_free(points, valid, touchable)
    points = jnp.where(usable[..., None], points, 0)
    way, carry = (jnp.zeros_like(points) if given is None else jnp.asarray(given) for given in (ways, carried))
    in_axes = (0, 0, 0, None if normals is None else 0, 0, 0, 0, 0, 0, 0)
    search = jax.vmap(partial(_search, config=config), in_axes=in_axes)
    normals = None if normals is None else jnp.asarray(normals)
    return search(points, usable, free, normals, target, _keys(key, slots), low, high, way, carry)


def _usable_and_free(
    points: Num[Array, "B M 3"], valid: Bool[AnyArray, "B M"] | None, touchable: Shaped[AnyArray, "B M"] | None
) -> tuple[Bool[Array, "B M"], Bool[Array, "B M"]]:
    """Points that count, and those of them that the hand can come to: all where there are none, bool [B, M] each."""
    usable = jnp.isfinite(points).all(-1)
    usable = usable if valid is None else usable & valid
    free = usable if touchable is None else usable & jnp.asarray(touchable, bool)
    return usable, jnp.where(free.any(-1, keepdims=True), free, usable)


def push_costs(
    centre: Float[Array, " 3"],
    target: Float[Array, " 3"],
    contact: Float[Array, "S 3"],
    direction: Float[Array, "S 3"],
    distance: Float[Array, " S"],
    moves: Bool[Array, " S"] | None = None,
) -> tuple[Float[Array, "S 3"], Float[Array, " S"]]:
    """The pushing model for S samples: the object's centre moves along, unless the hand moves away from it.

    Args:
        centre: mean of the object's points, [3].
        target: where it should be, [3].
        contact: where each sample touches, [S, 3].
        direction: which way each goes, unit, [S, 3].
        distance: how far, [S].
        moves: bool [S], whether the push moves the object; None if that depends on its direction from the centre.

    Returns:
        Predicted centres [S, 3] and their distances to the target [S].
    """
    if moves is None:
        moves = ((centre[None] - contact) * direction).sum(-1) >= 0
    predicted = centre[None] + jnp.where(moves, distance, 0)[:, None] * direction
    return predicted, safe_norm(predicted - target[None])


def push_waypoints(
    push: Push, config: PushConfig = PushConfig(), *, hand: Num[AnyArray, "*#B 4"] | tuple[float, ...] = HAND_DOWN
) -> PushWaypoints:
    """Waypoints of the closed hand for each push.

    Args:
        push: what ``best_push`` returned.
        config: geometry and speeds.
        hand: present orientation wxyz, [4] or [B, 4]. The hand is symmetric about its axis by half a turn; of the two
            ways of holding it the nearer to this one is taken.

    Returns:
        Poses of the grip site with the hand's orientation: z out of the fingers, y across them, as ``step_ee_pose``.
    """
    along, up = push.direction, jnp.array([[0.0, 0.0, config.lift]])
    start = push.contact - config.start_distance * along
    end = push.contact + push.distance[:, None] * along
    rest = push.contact - config.retreat * config.start_distance * along
    pos = jnp.stack([start + up, start, end, rest, rest + up], axis=1)
    quat = jnp.broadcast_to(_hand_quat(along, config.slant, jnp.asarray(hand))[:, None], (*pos.shape[:2], 4))
    speeds = jnp.array([1.0, 1.0, config.push_speed, config.retreat_speed, 1.0])
    velocity = jnp.broadcast_to(speeds[None], pos.shape[:2])
    return PushWaypoints(jnp.concatenate([pos, quat], axis=-1), jnp.ones_like(velocity), velocity)


def _search(
    points: Num[Array, "M 3"],
    usable: Bool[Array, " M"],
    free: Bool[Array, " M"],
    normals: Num[Array, "M 3"] | None,
    target: Num[Array, " 3"],
    key: Shaped[Array, ...],
    low: Float[Array, ""],
    high: Float[Array, ""],
    ways: Num[Array, "M 3"],
    carried: Num[Array, "M 3"],
    config: PushConfig,
) -> Push:
    """One slot: points [M, 3], which count [M] and may be touched [M], normals or None, target [3], heights, joint."""
    across = jnp.array([1.0, 1.0, 0.0]) if config.level else jnp.ones(3)
    centre = points.sum(0) / jnp.maximum(usable.sum(), 1)
    # What is not to be judged is set equal, not left out.
    goal = jnp.where(across > 0, target, centre)
    which, how_far = jax.random.split(key)
    chosen = _draw(which, free, points[:, 2], low, high, config.num_samples)
    contact = points[chosen]
    contact = contact.at[:, 2].set(jnp.clip(contact[:, 2], low, high))
    way = ways[chosen]
    jointed = (way != 0).any(-1)
    direction = jnp.where(jointed[:, None], way, _unit((target[None] - contact) * across[None]))
    distance = jax.random.uniform(
        how_far, (config.num_samples,), minval=config.min_distance, maxval=config.max_distance
    )
    moves = None if normals is None else (normals[chosen] * direction).sum(-1) < 0
    predicted, cost = push_costs(centre, goal, contact, direction, distance, moves)
    against = jnp.ones_like(jointed) if moves is None else moves
    with_joint = centre[None] + jnp.where(against, distance, 0)[:, None] * carried[chosen]
    predicted = jnp.where(jointed[:, None], with_joint, predicted)
    cost = jnp.where(jointed, safe_norm(predicted - goal[None]), cost)
    best = jnp.argmin(cost)
    behind = _behind(points, usable, contact[best], direction[best], config)
    return Push(
        contact=contact[best] - behind * direction[best],
        direction=direction[best],
        distance=distance[best],
        cost=jnp.where(usable.any(), cost[best], jnp.inf),
        predicted=predicted[best],
    )


def _draw(
    key: Shaped[Array, ...],
    usable: Bool[Array, " M"],
    heights: Num[Array, " M"],
    low: Float[Array, ""],
    high: Float[Array, ""],
    count: int,
) -> Int[Array, " count"]:
    """``count`` indices of points, uniformly among those at an allowed height; among all if there are none there."""
    within = usable & (heights >= low) & (heights <= high)
    chosen = jnp.cumsum(jnp.where(within.any(), within, usable))
    nth = jax.random.randint(key, (count,), 0, jnp.maximum(chosen[-1], 1))
    return jnp.searchsorted(chosen, nth, side="right").clip(0, len(heights) - 1)


def _behind(
    points: Num[Array, "M 3"],
    usable: Bool[Array, " M"],
    contact: Float[Array, " 3"],
    direction: Float[Array, " 3"],
    config: PushConfig,
) -> Float[Array, ""]:
    """How far the object extends behind a contact, in the path of the hand and after its start."""
    offset = points - contact[None]
    back = -(offset * direction[None]).sum(-1)
    aside = offset + back[:, None] * direction[None]
    met = usable & (safe_norm(aside[:, :2]) <= config.hand_width / 2) & (back < config.start_distance)
    met &= offset[:, 2] > -config.tip
    return jnp.max(jnp.where(met, back, 0), initial=0)


def _hand_quat(along: Float[Array, "B 3"], slant: float, hand: Float[Array, "*#B 4"]) -> Float[Array, "B 4"]:
    """Orientation wxyz [B, 4] of a hand whose fingers point down, slanted towards ``along`` [B, 3], y across it."""
    level = along * jnp.array([[1.0, 1.0, 0.0]])
    # A push straight down has no heading; the hand then faces away from the robot's base.
    level = jnp.where(safe_norm(level)[:, None] > _NO_WAY, _unit(level), jnp.array([[1.0, 0.0, 0.0]]))
    out = jnp.sin(slant) * level - jnp.cos(slant) * jnp.array([[0.0, 0.0, 1.0]])
    left = jnp.cross(jnp.array([[0.0, 0.0, 1.0]]), level)
    quat = mat_to_quat(jnp.stack([jnp.cross(left, out), left, out], axis=-1))
    turned = quat_mul(quat, jnp.array([[0.0, 0.0, 0.0, 1.0]]))
    hand = jnp.broadcast_to(hand, quat.shape)
    nearer = jnp.abs((quat * hand).sum(-1)) >= jnp.abs((turned * hand).sum(-1))
    return jnp.where(nearer[:, None], quat, turned)


def _unit(vectors: Float[Array, "*B 3"]) -> Float[Array, "*B 3"]:
    """Vectors [..., 3] scaled to length 1, zero where there is no direction."""
    length = safe_norm(vectors)[..., None]
    return jnp.where(length > _NO_WAY, vectors / jnp.where(length > _NO_WAY, length, 1), 0)


def _heights(limit: Num[AnyArray, " B"] | Num[AnyArray, ""] | float | None, default: float, slots: int) -> jax.Array:
    return jnp.broadcast_to(jnp.asarray(default if limit is None else limit, jnp.float32), (slots,))


def _keys(key: jax.Array, slots: int) -> jax.Array:
    """A key a slot, from one key or from as many."""
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    single = key.ndim == (0 if typed else 1)
    if single:
        return jax.random.split(key, slots)
    if len(key) != slots:
        raise ValueError(f"key must be one key or {slots}, one a slot; got {len(key)}")
    return key
