"""What an agent is asked to achieve in a scene, and how far it has come: verdicts and potentials of one world, in JAX.

In: a scene, a task and the name of an objective; later a world's state. Out: ``success`` (bool) and ``potential`` (from
0 to 1, higher is closer), pure functions for ``jit`` and ``vmap``.

``goal``: the task's own BDDL goal, judged as everywhere else in this package.
``reach``: the point between the fingertips is within ``reach_distance`` of the box around the target's collision
geometry; the box turns with the target.
``lift``: the target's origin is ``lift_height`` above where it was when the episode began.

A shaped reward is the sparse one plus the change of the potential. Its sum over an episode is at most 2, and as no
potential exceeds the 1 that success is worth, an agent gains nothing by staying close without succeeding.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from vecenv.errors import InvalidInput
from vecenv.libero.scene import goals
from vecenv.libero.scene.bddl import Problem
from vecenv.libero.scene.scene import Scene
from vecenv.util.rotations import quat_to_mat, safe_norm

OBJECTIVES = ("goal", "reach", "lift")

# Distances in metres (and joint positions in radians) are scored 1 - tanh(5 d): 0.5 at 11 cm.
_SHARPNESS = 5.0
# How far below a thing's top a hand takes hold of it: about the length of the finger pads, metres.
_GRASP_DEPTH = 0.03
# Within about this distance of the grasp point closing the hand counts as progress, metres.
_GRASP_RADIUS = 0.015
# What is carried passes this far above what stands around its place, and at least this far above the ground, metres.
_CLEARANCE, _RAISED = 0.03, 0.05
# Carrying counts from this horizontal distance on, every centimetre of it the same, metres.
_CARRY_RANGE = 0.5
# Within about this horizontal distance a thing counts as above its place, metres.
_PLACE_RADIUS = 0.06


# Predicates that want a thing at a place.
_AT_PLACES = (goals.IN_REGION, goals.ON_REGION, goals.ON_OBJECT)


class ObjectiveError(InvalidInput):
    """An objective that the scene does not offer; the message says what would be right."""


class View(NamedTuple):
    """What objectives read of one world; kinematics as of the start of the last substep.

    Attributes:
        qpos: [nq].
        xpos: body positions, world frame, metres, [nbody, 3].
        xquat: body orientations, wxyz, [nbody, 4].
        site_xpos: site positions, [nsite, 3].
        site_xmat: site rotations, [nsite, 3, 3].
        touch: contact sensors, [nsensordata].
        gripper: integrated finger targets; the first is 1 when the hand opens fully and -1 when it closes fully, [2].
        start_height: height of the target's origin when the episode began, metres.
    """

    qpos: Float[Array, " nq"]
    xpos: Float[Array, "nbody 3"]
    xquat: Float[Array, "nbody 4"]
    site_xpos: Float[Array, "nsite 3"]
    site_xmat: Float[Array, "nsite 3 3"]
    touch: Float[Array, " nsensordata"]
    gripper: Float[Array, "2"]
    start_height: Float[Array, ""]


class Box(NamedTuple):
    """A box in a body's frame: ``body`` id, ``centre`` [3] and ``half`` extents [3] in metres."""

    body: int
    centre: Float[np.ndarray, "3"]
    half: Float[np.ndarray, "3"]


def default_target(scene: Scene, problem: Problem, *, movable: bool) -> str:
    """The first thing the task is about: an object if there is one, else (unless ``movable``) a fixture.

    Raises:
        ObjectiveError: there is none.
    """
    owners = {region.name: region.target for region in problem.regions}
    named = [owners.get(name, name) for name in problem.obj_of_interest]
    known = [scene.entities[name] for name in named if name in scene.entities]
    objects = [entity.name for entity in known if not entity.fixture]
    if objects:
        return objects[0]
    if movable or not known:
        choices = ", ".join(entity.name for entity in scene.objects)
        raise ObjectiveError(f"{problem.source} is about no movable object; give target, one of {choices}")
    return known[0].name


def body_box(model: mujoco.MjModel, body: int) -> Box:
    """The box around the collision geometry of a body and of all that hangs on it, joints at their reference.

    A body without collision geometry has a box of no size at its origin.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    corners = [_corners(model, data, geom) for geom in np.flatnonzero(solid).tolist() if _hangs_on(model, geom, body)]
    local = (np.concatenate([*corners, data.xpos[None, body]]) - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
    if corners:
        local = local[:-1]
    low, high = local.min(axis=0), local.max(axis=0)
    return Box(body, ((low + high) / 2).astype(np.float32), ((high - low) / 2).astype(np.float32))


def _corners(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Float[np.ndarray, "8 3"]:
    """World positions of the corners of the box around a geom, [8, 3]."""
    centre, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
    local = centre + half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T


def _hangs_on(model: mujoco.MjModel, geom: int, body: int) -> bool:
    carrier = int(model.geom_bodyid[geom])
    while carrier not in (0, body):
        carrier = int(model.body_parentid[carrier])
    return carrier == body


class Objective:
    """One objective in one scene.

    Args:
        scene: the compiled scene.
        problem: the task.
        kind: one of ``OBJECTIVES``.
        target: name of an object, or of a fixture unless it is to be lifted; None for the first the task is about.
        reach_distance: metres.
        lift_height: metres.

    Raises:
        ObjectiveError: an unknown kind or target, or a target that cannot be lifted.

    Attributes:
        target: name of the target.
        box: box around the target.
    """

    def __init__(
        self,
        scene: Scene,
        problem: Problem,
        kind: str,
        *,
        target: str | None = None,
        reach_distance: float = 0.02,
        lift_height: float = 0.05,
    ) -> None:
        if kind not in OBJECTIVES:
            raise ObjectiveError(f"objective={kind!r}: expected one of {', '.join(OBJECTIVES)}")
        self.kind, self._grip_site = kind, scene.grip_site
        self.target = target or default_target(scene, problem, movable=kind == "lift")
        if self.target not in scene.entities:
            raise ObjectiveError(f"target={self.target!r}: this scene has {', '.join(scene.entities)}")
        if kind == "lift" and scene.entities[self.target].fixture:
            choices = ", ".join(entity.name for entity in scene.objects)
            raise ObjectiveError(f"target={self.target!r} is fixed to the world; lift one of {choices}")
        self._reach_distance, self._lift_height = reach_distance, lift_height
        self.box = body_box(scene.model, scene.model.body(scene.entities[self.target].root_body).id)
        table = goals.build_table([problem], scene, [0])
        self._table = goals.GoalTable(*(np.asarray(column) for column in table))
        self._subjects = [body_box(scene.model, body) for body in _subjects(scene.model, self._table)]
        self._places = [_place_box(scene, self._table, index) for index in range(len(self._subjects))]
        self._ground = scene.arena.workspace_offset[2]

    def height(self, view: View) -> Float[Array, ""]:
        """Height of the target's origin, metres."""
        return view.xpos[self.box.body, 2]

    def offset(self, view: View) -> Float[Array, "3"]:
        """From the point between the fingertips to the centre of the target's box, metres, world frame, [3]."""
        return _centre(view, self.box) - self._grip(view)

    def success(self, view: View) -> Bool[Array, ""]:
        """Whether the objective is achieved, bool."""
        if self.kind == "reach":
            return _distance(view, self.box, self._grip(view)) <= self._reach_distance
        if self.kind == "lift":
            return self.height(view) - view.start_height >= self._lift_height
        return jnp.all(self._holds(view))

    def potential(self, view: View) -> Float[Array, ""]:
        """How near the objective is, in [0, 1].

        ``reach``: the score of the distance to the box, see ``reach_distance``.
        ``lift``: 0.3 for nearness to a point at most 3 cm below the target's top, 0.2 for closing the hand there, 0.5
        for the height gained.
        ``goal``: the mean over the goal's predicates: 1 if one holds. Of one that brings an object to a place, while
        it does not hold: 0.2 for raising the object to 3 cm above what stands around the place (a basket's rim), 0.35
        for nearing the place horizontally at that height, 0.1 for lowering it there; and for the first such predicate
        0.1 for the hand's nearness to the object and 0.1 for closing it there, which an object above its place no
        longer needs, and there 0.15 for opening the hand. Of other ones 0.6 for nearness of the thing to its place, of
        the joint to its bound, and for the first 0.3 for nearness of the hand to the thing.
        """
        if self.kind == "reach":
            return _score(_distance(view, self.box, self._grip(view)))
        return self._lifted(view) if self.kind == "lift" else self._towards_goal(view)

    def _grip(self, view: View) -> Float[Array, "3"]:
        return view.site_xpos[self._grip_site]

    def _lifted(self, view: View) -> Float[Array, ""]:
        near, closing = self._held(view, self.box)
        gained = jnp.clip((self.height(view) - view.start_height) / self._lift_height, 0, 1)
        return 0.3 * near + 0.2 * closing + 0.5 * gained

    def _held(self, view: View, box: Box) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """How near the hand is to where it takes hold of a thing, and how far it is closed there, both in [0, 1]."""
        away = safe_norm(_grasp_point(view, box) - self._grip(view))
        return _score(away), jnp.exp(-((away / _GRASP_RADIUS) ** 2)) * (1 - view.gripper[0]) / 2

    def _towards_goal(self, view: View) -> Float[Array, ""]:
        holds = self._holds(view)
        first = jnp.arange(len(holds)) == jnp.argmin(holds)
        parts = [self._progress(view, index) for index in range(len(self._subjects))]
        done, by_hand = (jnp.stack(column) for column in zip(*parts, strict=True))
        return jnp.mean(jnp.where(holds, 1.0, done + jnp.where(first, by_hand, 0.0)))

    def _progress(self, view: View, index: int) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """How far one predicate has come: the thing's own part of the potential, and the hand's."""
        box, place = self._subjects[index], self._places[index]
        if place is None:
            near = _score(_distance(view, box, self._grip(view)))
            return 0.6 * _score(self._missing(view, index)), 0.3 * near
        away = self._place(view, index) - view.xpos[box.body]
        flat = safe_norm(away[:2])
        above = jnp.exp(-((flat / _PLACE_RADIUS) ** 2))
        bottom = _centre(view, box)[2] - _half_height(view, box) - self._ground
        rim = _centre(view, place)[2] + _half_height(view, place) - self._ground
        needed = jnp.maximum(rim + _CLEARANCE, _RAISED)
        high = jnp.maximum(jnp.clip(bottom / needed, 0, 1), above)
        lowered = above * _score(safe_norm(away))
        near, closing = (jnp.maximum(part, above) for part in self._held(view, box))
        opened = above * (1 + view.gripper[0]) / 2
        nearer = jnp.clip(1 - flat / _CARRY_RANGE, 0, 1)
        carried = 0.2 * high + 0.35 * high * nearer + 0.1 * lowered
        return carried, 0.1 * near + 0.1 * closing + 0.15 * opened

    def _holds(self, view: View) -> Bool[Array, " P"]:
        """Which predicates of the goal hold, bool [P]."""
        table = jax.tree.map(jnp.asarray, self._table)
        return goals.predicates(
            table,
            xpos=view.xpos[None],
            site_xpos=view.site_xpos[None],
            site_xmat=view.site_xmat[None],
            qpos=view.qpos[None],
            touch=view.touch[None],
            xp=jnp,
        )[0]

    def _missing(self, view: View, index: int) -> Float[Array, ""]:
        """How far the thing of one predicate is from its place, metres, or a joint from its bound."""
        row = goals.GoalTable(*(column[0, index] for column in self._table))
        if row.kind in (goals.ANY_JOINT, goals.ALL_JOINTS):
            used = row.joint_used
            gaps = jnp.maximum(row.joint_bound[used] - row.joint_sign[used] * view.qpos[row.joint[used]], 0.0)
            return jnp.min(gaps) if row.kind == goals.ANY_JOINT else jnp.max(gaps)
        if row.kind in _AT_PLACES:
            return safe_norm(view.xpos[row.body] - self._place(view, index))
        if row.kind == goals.UP:
            return jnp.maximum(goals.UP_HEIGHT - view.xpos[row.body, 2], 0.0)
        return jnp.zeros(())

    def _place(self, view: View, index: int) -> Float[Array, "3"]:
        """Where one predicate wants its thing, metres, world frame."""
        row = goals.GoalTable(*(column[0, index] for column in self._table))
        if row.kind == goals.ON_OBJECT:
            return view.xpos[row.reference]
        return jnp.asarray(row.zone_pos) if row.site < 0 else view.site_xpos[row.site]


def _subjects(model: mujoco.MjModel, table: goals.GoalTable) -> list[int]:
    """The body that each predicate is about: the thing, or the part that a joint moves."""
    jointed = np.isin(table.kind[0], (goals.ANY_JOINT, goals.ALL_JOINTS))
    owners = {int(at): int(body) for at, body in zip(model.jnt_qposadr, model.jnt_bodyid, strict=True)}
    return [
        owners[int(joint[0])] if by_joint else int(body)
        for by_joint, joint, body in zip(jointed, table.joint[0], table.body[0], strict=True)
    ]


def _place_box(scene: Scene, table: goals.GoalTable, index: int) -> Box | None:
    """What stands around the place of one predicate; None if that is not about an object and a place."""
    row = goals.GoalTable(*(column[0, index] for column in table))
    movable = {scene.model.body(entity.root_body).id for entity in scene.objects}
    if row.kind not in _AT_PLACES or int(row.body) not in movable:
        return None
    if row.kind == goals.ON_OBJECT:
        return body_box(scene.model, int(row.reference))
    if row.site < 0:
        return Box(0, np.asarray(row.zone_pos, np.float32), np.zeros(3, np.float32))
    return body_box(scene.model, int(scene.model.site_bodyid[row.site]))


def _score(distance: Float[Array, ""]) -> Float[Array, ""]:
    return 1 - jnp.tanh(_SHARPNESS * distance)


def _axes(view: View, body: int) -> Float[Array, "3 3"]:
    """Rotation matrix of a body; from the quaternion, which is all that is kept."""
    return quat_to_mat(view.xquat[body])


def _centre(view: View, box: Box) -> Float[Array, "3"]:
    return view.xpos[box.body] + jnp.sum(_axes(view, box.body) * box.centre[None], axis=-1)


def _distance(view: View, box: Box, point: Float[Array, "3"]) -> Float[Array, ""]:
    """From a point to a box, metres; 0 inside."""
    axes = _axes(view, box.body)
    local = jnp.sum(axes * (point - view.xpos[box.body])[:, None], axis=0) - box.centre
    return safe_norm(jnp.maximum(jnp.abs(local) - box.half, 0.0))


def _grasp_point(view: View, box: Box) -> Float[Array, "3"]:
    """Where a hand from above takes hold: on the box's vertical middle line, near its top."""
    rise = jnp.maximum(_half_height(view, box) - _GRASP_DEPTH, 0.0)
    return _centre(view, box) + rise * jnp.asarray([0.0, 0.0, 1.0])


def _half_height(view: View, box: Box) -> Float[Array, ""]:
    """Half of how high a box is as it stands, metres."""
    return jnp.sum(jnp.abs(_axes(view, box.body)[2]) * box.half)
