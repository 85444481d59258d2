"""Reading the constants of a robot arm from a compiled MuJoCo model.

In: a model and the names of the arm's joints, site and hand. Out: a ``kinematics.Chain``. This is the only part of the
controllers that knows MuJoCo; it runs once a model.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from vecenv.controllers.kinematics import NUM_BODIES, NUM_FINGERS, Chain
from vecenv.controllers.osc import NUM_JOINTS


def chain_from_model(
    model: mujoco.MjModel,
    *,
    arm_joints: Sequence[str],
    finger_joints: Sequence[str],
    site: str,
    hand: str,
) -> Chain:
    """Read the constants of an arm of seven hinges with two sliding fingers on its last link.

    Args:
        model: a compiled model whose first nine joints are the arm's and the fingers'.
        arm_joints: names of the hinges, from the base outward.
        finger_joints: names of the slides.
        site: name of the controlled site.
        hand: name of the body whose orientation is reported.

    Returns:
        The constants, float64 NumPy arrays.

    Raises:
        ValueError: a name is missing, or the robot is not built as described; the message says what is wrong.
    """
    names = (*arm_joints, *finger_joints)
    if len(arm_joints) != NUM_JOINTS or len(names) != NUM_BODIES:
        raise ValueError(f"need {NUM_JOINTS} arm joints and {NUM_FINGERS} finger joints, got {', '.join(names)}")
    for index, name in enumerate(names):
        _check_joint(model, name, index)
    bodies = model.jnt_bodyid[:NUM_BODIES].tolist()
    _check_tree(model, bodies)
    if np.any(model.tendon_armature):
        raise ValueError("a tendon has armature, which would add to the mass matrix")
    site_id = _require(model, mujoco.mjtObj.mjOBJ_SITE, site)
    hand_id = _require(model, mujoco.mjtObj.mjOBJ_BODY, hand)
    for what, body in ((f"site {site!r}", model.site_bodyid[site_id]), (f"body {hand!r}", hand_id)):
        if model.body_weldid[body] != bodies[NUM_JOINTS - 1]:
            raise ValueError(f"{what} must be fixed to the link of joint {names[NUM_JOINTS - 1]!r}")
    return _measure(model, bodies, site_id, hand_id)


def _require(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        raise ValueError(f"the model has no {kind.name.removeprefix('mjOBJ_').lower()} {name!r}")
    return found


def _check_joint(model: mujoco.MjModel, name: str, index: int) -> None:
    """The joint is of the right type, and number ``index`` in the model."""
    found = _require(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    wanted = mujoco.mjtJoint.mjJNT_HINGE if index < NUM_JOINTS else mujoco.mjtJoint.mjJNT_SLIDE
    if model.jnt_type[found] != wanted:
        raise ValueError(f"joint {name!r} must be a {wanted.name.removeprefix('mjJNT_').lower()}")
    if found != index:
        raise ValueError(f"joint {name!r} must be number {index} of the model, it is number {found}")


def _check_tree(model: mujoco.MjModel, bodies: Sequence[int]) -> None:
    """Each link hangs on the one before, the first on the world, the fingers on the last, and nothing else on them."""
    last = bodies[NUM_JOINTS - 1]
    parents = [0, *bodies[: NUM_JOINTS - 1], last, last]
    for joint, body in enumerate(model.jnt_bodyid):
        name, carrier = model.joint(joint).name, model.body_weldid[model.body_parentid[body]]
        if joint < NUM_BODIES and carrier != parents[joint]:
            raise ValueError(f"joint {name!r} must move against body {model.body(parents[joint]).name!r}")
        if joint >= NUM_BODIES and carrier in bodies:
            raise ValueError(f"joint {name!r} hangs on the robot, which may have no more than {NUM_BODIES} joints")


def _measure(model: mujoco.MjModel, bodies: Sequence[int], site: int, hand: int) -> Chain:
    """The constants as MuJoCo's kinematics shows them in the reference configuration."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    hinge = data.xanchor[:NUM_JOINTS]
    parts = [_welded_together(model, data, body) for body in bodies]
    weightless = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY
    return Chain(
        reference=model.qpos0[:NUM_BODIES].copy(),
        base=hinge[0].copy(),
        axis=data.xaxis[:NUM_JOINTS].copy(),
        offset=np.diff(hinge, axis=0),
        slide=data.xaxis[NUM_JOINTS:NUM_BODIES].copy(),
        mass=np.array([mass for mass, _, _ in parts]),
        com=np.array([com for _, com, _ in parts]) - hinge[[*range(NUM_JOINTS), *[-1] * NUM_FINGERS]],
        inertia=np.array([inertia for _, _, inertia in parts]),
        armature=model.dof_armature[:NUM_JOINTS].copy(),
        gravity=np.zeros(3) if weightless else model.opt.gravity.copy(),
        site_offset=data.site_xpos[site] - hinge[-1],
        site_axes=data.site_xmat[site].reshape(3, 3).T.copy(),
        hand_quat=data.xquat[hand].copy(),
    )


def _welded_together(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass [3] and inertia about it [3, 3] of a moving body and all that is fixed to it."""
    parts = np.flatnonzero(model.body_weldid == body)
    mass = model.body_mass[parts]
    com = mass @ data.xipos[parts] / mass.sum()
    inertia = np.zeros((3, 3))
    for part, m in zip(parts, mass, strict=True):
        axes, arm = data.ximat[part].reshape(3, 3), data.xipos[part] - com
        inertia += (axes * model.body_inertia[part]) @ axes.T + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return float(mass.sum()), com, inertia
